"""docs/reference/nodes.md lists subscriptions, publishers, services and parameters of each node.

scripts/generate rewrites the page.
"""

import inspect
import os
import re
from importlib.resources import files

import pytest
import rclpy
from rclpy.action import get_action_server_names_and_types_by_node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from support.node_list import (
    NEEDED,
    NODES,
    OF_EVERY_NODE,
    OWN_WORDS,
    ROOT,
    VARIANTS,
    default_of,
    node_class,
    variant_text,
)

from thinmap_ros.logs.bag_writer import BagWriter

PAGE = ROOT / 'docs' / 'reference' / 'nodes.md'
# Topics of rclpy and of its lifecycle, which every node has.
COMMON = ('/parameter_events', '/rosout', '/clock', '/diagnostics', 'transition_event')
HEAD = """# Nodes

Made from the nodes themselves; do not edit (see `test/docs/test_node_reference.py`). Names without a leading slash are
relative: a namespace goes before them. Every node but the monitor publishes `/diagnostics`; all follow `/clock` with
`use_sim_time`. Nodes with the parameter `autostart` are lifecycle nodes (`~/change_state`, `~/get_state`, ...).
[Messages](messages.md) lists the fields of the types of `thinmap_msgs`. The order is that in which data pass, from the laser to the wheels; then come
nodes for several robots, for people, and for recordings.

![A laser and odometry lead to a pose, a map, a graph, an exploration and commands](../images/nodes.svg)
"""  # noqa: E501
PICTURE = ROOT / 'docs' / 'images' / 'nodes.svg'
ORDER = (
    'sim',
    'localizer',
    'grid_mapper',
    'topology_builder',
    'global_localizer',
    'explorer',
    'navigator',
    'map_joiner',
    'web',
    'markers',
    'rerun_viewer',
    'recorder',
    'bag_player',
    'demo_monitor',
)


@pytest.fixture
def declared(ros_domain, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    BagWriter(tmp_path / 'some_bag', live=True).close()
    arguments = [
        word for name in NODES for k, v in NEEDED.get(name, {}).items() for word in rule(name, k, v)
    ]

    def shown(name, show, variant=()):
        """What is shown of a node, which has other parameters with those of its variant."""
        words = [word for key, value in variant for word in rule(name, key, value)]
        rclpy.init(args=['--ros-args', *arguments, *words])
        try:
            node = node_class(name)()
            text = show(name, node)
            getattr(node, 'close', lambda: None)()
            node.destroy_node()
            return text
        finally:
            rclpy.shutdown()

    return shown


def rule(name, key, value):
    return ('-p', f'{name}:{key}:={str(value).lower() if isinstance(value, bool) else value}')


def kind_of(message):
    package, part = message.__module__.split('.')[:2]
    return f'{package}/{part}/{message.__name__}'


def quality(profile):
    reliable = 'reliable' if profile.reliability == ReliabilityPolicy.RELIABLE else 'best effort'
    latched = ', latched' if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL else ''
    return f'{reliable}{latched}, {profile.depth}'


def relative(name, node):
    own = f'/{node}/'
    name = f'~/{name[len(own) :]}' if name.startswith(own) else name
    return name if name in ('/tf', '/tf_static', '/clock') else name.removeprefix('/')


def topics(entities, node):
    rows = {
        (relative(e.topic_name, node), kind_of(e.msg_type), quality(e.qos_profile))
        for e in entities
        if not e.topic_name.endswith(COMMON)
    }
    return [f'| `{topic}` | `{kind}` | {profile} |' for topic, kind, profile in sorted(rows)]


def services(node, name):
    found = {(relative(s.srv_name, name), kind_of(s.srv_type)) for s in node.services}
    return [
        f'`{topic}` (`{kind}`)'
        for topic, kind in sorted(found)
        if kind.startswith(('std_srvs', 'thinmap'))
    ]


def actions(node):
    found = get_action_server_names_and_types_by_node(node, node.get_name(), node.get_namespace())
    return [f'`{name.removeprefix("/")}` (`{types[0]}`)' for name, types in sorted(found)]


def parameters(name, node):
    """Rows of the table by the names of the parameters."""
    return dict(parameter_rows(node, name))


def parameter_rows(node, name):
    for key in node._parameters:
        if key in OF_EVERY_NODE or key in OWN_WORDS or key.startswith('qos_overrides'):
            continue
        value = (
            default_of(name, key) if key in NEEDED.get(name, {}) else node.get_parameter(key).value
        )
        descriptor = node.describe_parameter(key)
        limits = [*descriptor.floating_point_range, *descriptor.integer_range]
        span = (
            f'{limits[0].from_value:g} to {limits[0].to_value:g}'
            if limits
            else descriptor.additional_constraints
        )
        live = '' if descriptor.read_only else 'yes'
        if limits and descriptor.additional_constraints:
            live = descriptor.additional_constraints.removeprefix('at run time ')
        shown = f'`{value}`' if value != '' else ''
        yield key, f'| `{key}` | {shown} | {span} | {live} | {descriptor.description} |'


def section(name, node):
    lines = [f'## {name}', '', inspect.getmodule(type(node)).__doc__.strip(), '']
    lines += [' '.join(inspect.cleandoc(type(node).__doc__).split()), '']
    for what, entities in (('Subscribes to', node.subscriptions), ('Publishes', node.publishers)):
        if rows := topics(entities, name):
            lines += [f'| {what} | type | quality, depth |', '|---|---|---|', *rows, '']
    for what, found in (('Services', services(node, name)), ('Actions', actions(node))):
        if found:
            lines += [f'{what}: {", ".join(found)}', '']
    return lines


def parameter_table(rows):
    head = ['| parameter | default | allowed | at run time | what |', '|---|---|---|---|---|']
    return [*head, *rows, ''] if rows else []


def other_parameters(rows, others):
    """Table of the parameters that only a variant of the node has; rows, others: by their names."""
    own = [row for key, row in others.items() if key not in rows]
    return [variant_text(rows, others, quote='`'), '', *parameter_table(own)]


def arrows():
    """Source, target and topics of each arrow of the picture."""
    found = re.findall(
        r'data-from="(.+?)" data-to="(.+?)" data-topics="(.+?)"', PICTURE.read_text()
    )
    assert len(found) > 5
    return [(source, target, set(topics.split(', '))) for source, target, topics in found]


def section_of(text, node):
    return text.partition(f'\n## {node}\n')[2].partition('\n## ')[0]


def listed(text, what):
    """Topics of a table of a node."""
    table = text.partition(f'| {what} |')[2].partition('\n\n')[0]
    return set(re.findall(r'^\| `(.+?)`', table, re.MULTILINE))


def actions_of(text):
    return set(re.findall(r'`(\w+)` \(`\w+/action/', text))


def test_the_page_lists_what_the_nodes_declare(declared):
    lines = [HEAD]
    assert sorted(ORDER) == NODES
    for name in ORDER:
        head, rows = declared(name, lambda *node: (section(*node), parameters(*node)))
        lines += [*head, *parameter_table(rows.values())]
        if name in VARIANTS:
            others = declared(name, parameters, VARIANTS[name].items())
            lines += other_parameters(rows, others)
    text = '\n'.join(lines)
    if 'THINMAP_WRITE_CONFIG' in os.environ:
        PAGE.write_text(text)
    assert PAGE.read_text() == text, (
        f'{PAGE.name}: see the top of {__file__} for how to regenerate it'
    )
    for source, target, topics in arrows():
        taken = section_of(text, target)
        assert topics <= listed(section_of(text, source), 'Publishes') | actions_of(taken)
        assert topics <= listed(taken, 'Subscribes to') | actions_of(taken)
    assert files('thinmap_ros').joinpath('nodes', 'thinmap.py').is_file()
