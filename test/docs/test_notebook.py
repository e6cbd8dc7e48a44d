"""The notebook of the tutorials runs from its first cell to its last, and shows pictures."""

import re
from pathlib import Path

import pytest
from support.timeouts import PROGRAM_S

pytestmark = pytest.mark.programs
ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / 'docs' / 'tutorials' / 'notebook.py'
# No dependencies of the package: with the ROS of the system they may be missing.
jupytext = pytest.importorskip('jupytext')
nbclient = pytest.importorskip('nbclient')
pytest.importorskip('ipykernel')


def test_the_notebook_maps_a_log_finds_a_path_and_merges_two_sessions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('PYTHONPATH', str(ROOT), prepend=':')
    notebook = jupytext.read(NOTEBOOK)
    place = {'metadata': {'path': str(NOTEBOOK.parent)}}
    nbclient.NotebookClient(notebook, timeout=PROGRAM_S, resources=place).execute()
    outputs = [output for cell in notebook.cells for output in cell.get('outputs', [])]
    printed = ''.join(out.get('text', '') for out in outputs if out.get('name') == 'stdout')
    assert 'Pipeline(480 scans, GridPatch(' in printed
    assert re.search(r'^\d+\.\d m over nodes \(\d+, ', printed, re.MULTILINE)
    assert re.search(r'^x, y, heading of the second map: \[', printed, re.MULTILINE)
    assert sum('image/png' in output.get('data', {}) for output in outputs) == 3
