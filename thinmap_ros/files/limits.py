"""Limits of what is read from files and logs: a larger one is refused before it fills the memory.

One table for all formats; the readers name the limit in their error messages.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class FileLimits:
    """Maps, graphs, worlds, sessions and configuration files. Sizes in bytes."""

    text_bytes: int = 1 << 30
    yaml_bytes: int = 4 << 20
    yaml_nodes: int = 100_000  # values, lists and mappings
    yaml_levels: int = 20
    npz_bytes: int = 512 << 20  # decompressed
    npz_arrays: int = 64
    image_pixels: int = 1 << 26  # each needs up to 40 bytes while a graph is built
    image_side: int = 1 << 14
    image_header_bytes: int = 1 << 20
    image_comments: int = 100  # of a netpbm image whose pixels are written as text
    world_cells: int = 100_000_000
    digits: int = 100  # of a number
    name_length: int = 200
    path_length: int = 1000


@dataclass(frozen=True)
class LogLimits:
    """Bags and logs of sensor data. Sizes in bytes."""

    file_bytes: int = 32 << 30  # decompressed
    file_ratio: int = 200  # of decompressed to compressed bytes, beyond `small_file_bytes`
    small_file_bytes: int = 256 << 20
    line_bytes: int = 4 << 20  # of a text log
    lines: int = 1 << 23  # a day of odometry at 97 Hz
    chunk_bytes: int = 256 << 20  # uncompressed, and any other record
    summary_bytes: int = 64 << 20
    definitions_bytes: int = 64 << 20  # schemas and channels, all together
    definitions: int = 1 << 16
    schema_bytes: int = 1 << 20
    schema_fields: int = 8000  # with those of nested types, each time; and lines
    buffered_bytes: int = 512 << 20  # messages that wait to be sorted by time
    queue_depth: int = 100_000

    def unpacked_bytes(self, packed_bytes: int) -> int:
        """Largest size of a file that is compressed to a number of bytes."""
        return min(self.file_bytes, max(self.small_file_bytes, self.file_ratio * packed_bytes))


PIECE_BYTES = 1 << 20  # large files are read in pieces
FILES = FileLimits()
LOGS = LogLimits()
