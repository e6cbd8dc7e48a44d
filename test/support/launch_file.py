"""The launch file, read without launch, which only a whole ROS 2 has."""

import ast
from pathlib import Path

FILE = Path(__file__).resolve().parents[2] / 'launch' / 'thinmap.launch.py'


def constants():
    """Constants of the file by name."""
    assigned = [node for node in ast.parse(FILE.read_text()).body if isinstance(node, ast.Assign)]
    return {node.targets[0].id: ast.literal_eval(node.value) for node in assigned}
