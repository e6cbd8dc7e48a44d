"""What the nodes of a live graph say of themselves on /diagnostics."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus


class Doctor:
    """What the nodes last said of themselves, by node."""

    def __init__(self, graph):
        self.heard = graph.heard('/diagnostics', DiagnosticArray)

    def status(self, node):
        found = [s for array in self.heard for s in array.status if s.name == f'{node}: thinmap']
        return found[-1] if found else DiagnosticStatus(level=DiagnosticStatus.STALE)

    def times(self, node):
        """How often a node has said how it is."""
        return sum(s.name == f'{node}: thinmap' for array in self.heard for s in array.status)

    def value(self, node, key):
        return {pair.key: pair.value for pair in self.status(node).values}.get(key, '')

    def number(self, node, key):
        text = self.value(node, key)
        return float(text.split()[0]) if text else 0.0

    def level(self, node):
        return self.status(node).level
