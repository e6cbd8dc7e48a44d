"""Diagnostics of the nodes of a live graph."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus


class Doctor:
    """Last diagnostics by node."""

    def __init__(self, graph):
        self.heard = graph.heard('/diagnostics', DiagnosticArray)

    def status(self, node):
        found = [s for array in self.heard for s in array.status if s.name == f'{node}: thinmap']
        return found[-1] if found else DiagnosticStatus(level=DiagnosticStatus.STALE)

    def times(self, node):
        """Number of diagnostics of a node."""
        return sum(s.name == f'{node}: thinmap' for array in self.heard for s in array.status)

    def value(self, node, key):
        return {pair.key: pair.value for pair in self.status(node).values}.get(key, '')

    def number(self, node, key):
        text = self.value(node, key)
        return float(text.split()[0]) if text else 0.0

    def level(self, node):
        return self.status(node).level
