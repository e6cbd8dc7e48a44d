"""The HTML page of a run: complete, self-contained and small."""

import base64
from html.parser import HTMLParser

import numpy as np
import pytest

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.view import report_page
from thinmap_ros.view.summary import summary_figure

MAX_BYTES = 3_000_000
VOID = {'meta', 'img', 'input'}
EXPLORATION = {
    'reason': 'all end nodes resolved',
    'coverage': 0.9987,
    'distance': 12.34,
    'time': 79.2,
    'collisions': 0,
    'pose_rmse': 0.0123,
    'distance_at': {'0.99': None},
    'options': {'localization': 'slam', 'robot': '2dx'},
    'missing_area': {
        'expected_m2': 2.5,
        'bound_95_m2': 7.5,
        'places': [{'x': 1.0, 'y': -2.0, 'expected_m2': 1.5}],
    },
}


class Page(HTMLParser):
    """Text, table rows and referenced addresses of a page; its tags must be balanced."""

    def __init__(self, text):
        super().__init__()
        self.text = text
        self.rows = []
        self.addresses = []
        self._open = []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self._open.append(tag)
        if tag == 'tr':
            self.rows.append([])
        if tag in ('td', 'th'):
            self.rows[-1].append('')
        self.addresses += [value for name, value in attrs if name in ('src', 'href')]

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if self.rows and {'td', 'th'} & set(self._open):
            self.rows[-1][-1] += data


def page_of(folder, report=EXPLORATION, title='a room', command='thinmap explore_world a'):
    path = report_page.write(folder, title, report, command)
    assert path == folder / 'report.html'
    assert path.stat().st_size < MAX_BYTES
    return Page(path.read_text())


def test_figures_have_units(tmp_path):
    rows = page_of(tmp_path).rows
    assert ['Area seen', '99.9 %'] in rows
    assert ['Path length', '12.3 m'] in rows
    assert ['Position error (RMS)', '1.2 cm'] in rows
    assert ['Collisions', '0'] in rows
    assert ['Localization', 'slam'] in rows
    assert not [row for row in rows if '99 % seen' in row[0]], 'was not reached'


def test_figures_of_a_replay(tmp_path):
    report = {
        'scans': 30,
        'first_skipped': '',
        'cpu_ms_per_scan': 5.24,
        'ms_per_scan': {'all': {'median': 1.26, 'p95': 3.0, 'max': 9.0}},
    }
    page = page_of(tmp_path, report)
    assert page.rows == [
        ['Scans', '30'],
        ['CPU time per scan, whole program', '5.2 ms'],
        ['CPU time of pose and map, median', '1.3 ms'],
        ['CPU time of pose and map, 95th percentile', '3.0 ms'],
    ]
    assert 'What is missing' not in page.text


def test_missing_area_is_named_with_its_places(tmp_path):
    page = page_of(tmp_path)
    assert 'Expected unseen area: 2.5 m², 95 % bound: 7.5 m²' in page.text
    assert ['(1.00, -2.00) m', '1.5 m²'] in page.rows


@pytest.mark.parametrize(
    ('missing', 'text'),
    [
        (None, 'does not estimate'),
        ({'expected_m2': 0.0, 'bound_95_m2': 0.0, 'places': []}, 'No single place'),
        (
            {
                'expected_m2': 30.0,
                'bound_95_m2': 40.0,
                'places': 30 * [{'x': 0.0, 'y': 0.0, 'expected_m2': 1.0}],
            },
            'And 10 more places',
        ),
    ],
)
def test_nothing_missing_and_much_missing(tmp_path, missing, text):
    assert text in page_of(tmp_path, {'missing_area': missing}).text


def test_the_picture_is_part_of_the_page_and_nothing_else_is_loaded(tmp_path):
    cells = np.random.default_rng(0).choice([-1, 0, 100], (1000, 1000)).astype(np.int8)
    patch = GridPatch(GridFrame(0.0, 0.0, 0.05), cells)
    summary_figure(tmp_path / 'summary.png', patch, TopologicalMap(), np.zeros((1, 3)))
    (tmp_path / 'bag').mkdir()
    page = page_of(tmp_path)
    pictures = [address for address in page.addresses if address.startswith('data:image/png')]
    assert len(pictures) == 1
    assert set(page.addresses) - set(pictures) == {'bag', 'summary.png'}
    assert "default-src 'none'" in page.text
    assert '@import' not in page.text and 'url(' not in page.text and '<script' not in page.text


@pytest.mark.parametrize(
    ('curves', 'named', 'axes'),
    [
        ({'curve': [[0.0, 0.0, 0.1], [2.0, 1.0, 0.9]]}, 'Area seen', ('path (m)',)),
        ({'curve': [[0.0, 0.1], [2.0, 0.9]]}, 'Area seen', ('time (s)',)),
        (
            {'curve': [[0.0, 0.0, 0.1]], 'error_curve': [[0.0, 0.0], [2.0, 0.03]]},
            'Area seen and Position error',
            ('path (m)', 'time (s)'),
        ),
    ],
)
def test_curves_are_part_of_the_page(tmp_path, curves, named, axes):
    assert not page_of(tmp_path).addresses
    page = page_of(tmp_path, EXPLORATION | curves)
    assert f'alt="{named}"' in page.text
    (address,) = page.addresses
    text = base64.b64decode(address.removeprefix('data:image/svg+xml;base64,')).decode()
    assert all(f'{axis}</text>' in text for axis in axes)
    assert ('time (s)' in text) == ('time (s)' in axes)


def test_the_true_pose_has_no_curve_of_errors(tmp_path):
    assert not page_of(tmp_path, {'error_curve': [[0.0, 0.0], [1.0, 0.0]]}).addresses


def test_files_have_a_line_each(tmp_path):
    for name in ('map.pgm', 'report.json', 'unknown.bin'):
        (tmp_path / name).write_text('')
    rows = page_of(tmp_path, {}).rows
    assert [row[0] for row in rows] == ['map.pgm', 'report.json']
    assert all(row[1] for row in rows)


def test_text_is_escaped(tmp_path):
    page = page_of(tmp_path, {'reason': '<b>&'}, '<script>alert(1)</script>', "a '<i>'")
    assert '<script' not in page.text and '<b>' not in page.text and '<i>' not in page.text
    assert ['End of the exploration', '<b>&'] in page.rows
