"""The package thinmap_ros, for ROS and for pip.

colcon and the build farm call `setup.py develop` or `install`: each node and tool becomes a program
in lib/thinmap_ros, and config and worlds go to share/thinmap_ros. pip builds a wheel: it has the
one command `thinmap`, and the same data within the package.
"""

import re
import sys
from glob import glob
from pathlib import Path
from tempfile import TemporaryDirectory

from setuptools import find_packages, setup

NAME = 'thinmap_ros'

# What pip and `python -m build` run of this file.
IS_WHEEL = bool({'bdist_wheel', 'dist_info', 'editable_wheel', 'sdist'} & set(sys.argv))
# Folders of a wheel, as packages, and where they come from.
WHEEL_DATA = {
    f'{NAME}.data.{NAME}.config': 'config',
    f'{NAME}.data.{NAME}.config.robots': 'config/robots',
    f'{NAME}.data.{NAME}.config.sensors': 'config/sensors',
    f'{NAME}.data.{NAME}.worlds': 'worlds',
    f'{NAME}.data.thinmap_msgs.msg': 'thinmap_msgs/msg',
}
# Where a wheel is built: what an earlier one left in build/ would become part of it.
BUILD = TemporaryDirectory()
ROS_DATA = [
    ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
    (f'share/{NAME}', ['package.xml']),
    (f'share/{NAME}/config', glob('config/*.*')),
    (f'share/{NAME}/config/robots', glob('config/robots/*.yaml')),
    (f'share/{NAME}/config/sensors', glob('config/sensors/*.yaml')),
    (f'share/{NAME}/worlds', glob('worlds/*.yaml')),
    (f'share/{NAME}/launch', glob('launch/*.py')),
    # colcon puts it on PATH.
    ('bin', ['scripts/thinmap']),
]
# A program is a module with a `main`. `scripts/env` installs a new one when this file changes, or
# without .setup/package.stamp. The newest one is fetch_logs.
ROS_PROGRAMS = [
    f'{path.stem} = {NAME}.{folder}.{path.stem}:main'
    for folder in ('nodes', 'tools')
    for path in sorted((Path(__file__).parent / NAME / folder).glob('*.py'))
    if re.search(r'^(def )?main\b', path.read_text(), re.MULTILINE)
]


def version() -> str:
    """The version that the package itself names."""
    source = (Path(__file__).parent / NAME / '__init__.py').read_text()
    return re.search("^__version__ = '(.+)'$", source, re.MULTILINE)[1]


setup(
    name=NAME,
    version=version(),
    packages=[
        *find_packages(include=[NAME, f'{NAME}.*']),
        *(WHEEL_DATA if IS_WHEEL else []),
    ],
    options={'build': {'build_base': BUILD.name}} if IS_WHEEL else {},
    package_dir=WHEEL_DATA if IS_WHEEL else {},
    package_data={
        NAME: ['py.typed'],
        f'{NAME}.web': ['page/*'],
        '': ['*.yaml', '*.msg', '*.rviz', '*.json'],
    },
    data_files=[] if IS_WHEEL else ROS_DATA,
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
        'completion': ['argcomplete>=3'],
        'notebook': ['jupyterlab', 'jupytext'],
        'viewer': ['rerun-sdk>=0.41,<0.42'],  # its interface changes with each minor version
        'web': ['segno>=1.5', 'tornado>=6.2'],
        'test': [
            'hypothesis',
            'ipykernel',
            'jupytext',
            'nbclient',
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
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Science/Research',
        'License :: OSI Approved :: Apache Software License',
        'Operating System :: OS Independent',
        'Programming Language :: Python :: 3 :: Only',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Scientific/Engineering',
        'Typing :: Typed',
    ],
    description='Thinning-based topological mapping, exploration and SLAM for robots '
    'with one 2D laser scanner.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [f'thinmap = {NAME}.__main__:main'] if IS_WHEEL else ROS_PROGRAMS
    },
)
