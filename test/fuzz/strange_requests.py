"""Requests of pages with fields that do not belong there."""

import json
import math

VALID = [
    {'action': 'stop'},
    {'action': 'release', 'stop': 3, 'beat': 9},
    {'action': 'goal', 'x': 1, 'y': -2.5, 'theta': 0.1, 'beat': 9},
    {'action': 'initial_pose', 'x': 1, 'y': -2.5, 'theta': 0.1, 'beat': 9},
    {'action': 'go_to_region', 'region': 7, 'beat': 9},
    {'action': 'explore', 'area': [], 'return_home': False, 'beat': 9},
    {'action': 'explore', 'area': [[0, 0], [1, 0], [1, 1.5]], 'return_home': True, 'beat': 9},
    {'action': 'keep_out', 'corners': [[0, 0], [1, 0], [1, 1.5]], 'is_wall': False},
    {'action': 'keep_out', 'corners': [[0, 0], [1, 0]], 'is_wall': True},
    {'action': 'remove_keep_out', 'area': 3},
    {'action': 'erase', 'corners': [[0, 0], [1, 0], [1, 1.5]]},
    {'action': 'drive', 'ahead': -1.0, 'left': 0.5, 'beat': 9},
    {'action': 'save', 'name': 'floor_1'},
    {'action': 'name_region', 'region': 7, 'name': 'the large kitchen'},
    {'action': 'name_region', 'region': 7, 'name': ''},
    {'action': 'sessions'},
    {'action': 'merge', 'first': 'east', 'second': 'west'},
    {'action': 'merge_save', 'name': 'both'},
    {'action': 'merge_drop'},
]
STRANGE = (
    None,
    2**70,
    math.nan,
    math.inf,
    'x y',
    '../x',
    '\ud800',
    [[]],
    [[0, 0]],
    {},
    {'x': {}},
)
_ANY_TEXT = {('name_region', 'name')}


def mutated(rng):
    """A message that is no request: a field is strange, missing or too much, or it is no JSON."""
    content = dict(rng.choice(VALID))
    fields = [name for name in content if (content['action'], name) not in _ANY_TEXT]
    fields.remove('action')
    kind = rng.randrange(4)
    if kind == 0 and fields:
        content[rng.choice(fields)] = rng.choice(STRANGE)
    elif kind == 1 and fields:
        del content[rng.choice(fields)]
    elif kind == 2:
        content['action'] = rng.choice((*STRANGE, 'reboot'))
    else:
        content['force'] = rng.choice(STRANGE)
    text = json.dumps(content)
    if rng.random() < 0.2:
        text = text[: rng.randrange(len(text))]
    return text.encode() if rng.random() < 0.3 else text
