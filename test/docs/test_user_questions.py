"""docs/user_questions.md names tests that there are, and counts its answers."""

import re

from support.node_list import ROOT

ROWS = re.findall(
    r'^\| .+ \| .+ \| (yes|in part|no)\b.* \| (.*) \|$',
    (ROOT / 'docs' / 'user_questions.md').read_text(),
    re.M,
)


def test_there_are_fifty_questions_and_their_answers_are_counted():
    answers = [answer for answer, _ in ROWS]
    assert len(answers) == 50
    counts = [answers.count(answer) for answer in ('yes', 'in part', 'no')]
    text = (ROOT / 'docs' / 'user_questions.md').read_text()
    assert 'Yes: {}, in part: {}, no: {}.'.format(*counts) in text


def test_every_yes_has_a_test_and_every_test_exists():
    for answer, cell in ROWS:
        tests = re.findall(r'`([\w/]+\.py)::(\w+)`', cell)
        assert tests or answer != 'yes', cell
        for path, name in tests:
            source = (ROOT / 'test' / path).read_text()
            assert re.search(rf'^def {name}\(', source, re.M), (path, name)
