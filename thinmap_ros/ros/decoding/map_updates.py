"""Updates of a map, on a topic beside it."""

from rclpy.node import Node


def updates_topic(node: Node, topic: str) -> str:
    """Full name of the topic with the updates of a map, as RViz and costmaps name it.

    It follows the topic of the map, also where that is remapped.
    """
    return f'{node.resolve_topic_name(topic)}_updates'
