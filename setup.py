"""The ROS package thinmap_ros: nodes and tools."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'thinmap_ros'
NODES = [
    'sim',
    'grid_mapper',
    'topology_builder',
    'localizer',
    'explorer',
    'navigator',
    'recorder',
    'bag_player',
    'demo_monitor',
    'rerun_viewer',
    'markers',
    'global_localizer',
    'thinmap',
]
TOOLS = [
    'replay',
    'explore_world',
    'compare_exploration',
    'carmen_to_bag',
    'map_to_graph',
    'bag_repair',
    'demo',
    'warm_up',
    'experiment',
    'record_bags',
]

setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', glob('config/*.yaml')),
        (f'share/{NAME}/config/sensors', glob('config/sensors/*.yaml')),
        (f'share/{NAME}/worlds', glob('worlds/*.yaml')),
    ],
    install_requires=[
        'lz4',
        'matplotlib',
        'mcap',
        'numba',
        'numpy',
        'pillow',
        'pyyaml',
        'rosbags',
        'scipy',
        'tqdm',
        'zstandard',
    ],
    extras_require={
        'cluster': ['distributed'],
        'viewer': ['rerun-sdk>=0.41,<0.42'],  # its interface changes with each minor version
        'test': [
            'hypothesis',
            'networkx',
            'opencv-contrib-python-headless',
            'psutil',
            'pytest',
            'pytest-timeout',
            'pytest-xdist',
            'scikit-image',
        ],
    },
    python_requires='>=3.11',
    zip_safe=False,
    maintainer='thinmap maintainers',
    maintainer_email='maintainers@thinmap.invalid',
    description='Thinning-based topological mapping, exploration and SLAM for robots '
    'with one 2D laser scanner.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [f'{node} = {NAME}.nodes.{node}:main' for node in NODES]
        + [f'{tool} = {NAME}.tools.{tool}:main' for tool in TOOLS]
    },
)
