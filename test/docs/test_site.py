"""scripts/docs builds the site of all pages: every link and every heading that it names exists."""

import subprocess

import pytest
from support.node_list import ROOT

pytestmark = [
    pytest.mark.programs,
    pytest.mark.skipif(
        not (ROOT / '.setup').is_dir(), reason='scripts/docs installs packages below .setup/'
    ),
]


@pytest.mark.cpu_budget(30.0, 'all pages of the documentation')
def test_the_site_builds_without_a_warning():
    done = subprocess.run([ROOT / 'scripts' / 'docs'], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.strip() == 'out/site/index.html'
    site = ROOT / 'out' / 'site'
    assert 'class="doc' in (site / 'reference' / 'python_api.html').read_text(), 'docstrings'
    formulas = (site / 'theory' / 'ekf_slam_ti.html').read_text()
    assert '<math' in formulas and 'arithmatex' not in formulas
    assert '../../' not in (site / 'index.html').read_text(), 'links of the README'
