"""What can go wrong at the doors of thinmap, each said in one line."""


class ThinmapError(Exception):
    """Base of all errors that thinmap raises for its user; the message is one line."""


class InputError(ThinmapError):
    """A file, topic or message that cannot be used: the message names it, the value, and what was expected."""


class ConfigError(ThinmapError):
    """A parameter outside its range: the message names it, the value, and what was expected."""
