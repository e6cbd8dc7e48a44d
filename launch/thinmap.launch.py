"""Starts what `thinmap robot` starts: ros2 launch thinmap_ros thinmap.launch.py explore:=true."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    'preset': ('', 'parameters of a robot: mir100, pioneer, turtlebot3 or turtlebot4'),
    'map': ('', 'session to continue in'),
    'start': ('', 'pose X,Y,YAW in that map (m, m, rad), if it is known'),
    'save': ('', 'session to save at the end'),
    'bag': ('', 'folder of a bag to record all topics in'),
    'seconds': ('5', 'how long it looks at the robot first; 0: not at all'),
    'explore': ('false', 'explore, from the first scan on'),
    'web': ('false', 'with the page in the browser'),
    'namespace': ('', 'namespace of the nodes'),
    'params_file': ('', 'parameter file of the nodes'),
}
SWITCHES = ('explore', 'web')
OPTIONS = ('preset', 'map', 'start', 'save', 'bag', 'seconds')


def start(context):
    """The node, with the options that are given."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    words = [f'--{name}={given[name]}' for name in OPTIONS if given[name]]
    words += [f'--{name}' for name in SWITCHES if given[name].lower() == 'true']
    node = Node(
        package='thinmap_ros',
        executable='robot',
        namespace=given['namespace'],
        arguments=words,
        parameters=[given['params_file']] if given['params_file'] else [],
        output='screen',
        emulate_tty=True,
    )
    return [node]


def generate_launch_description():
    """What ros2 launch starts."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
