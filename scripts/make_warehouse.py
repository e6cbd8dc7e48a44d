"""Text of worlds/warehouse.yaml, 200 x 200 m of racks with goods in front.

It is printed by python -m scripts.make_warehouse.
"""

import numpy as np

_SIDE_M = 200.0
# Two racks back to back
_RACK_M = 2.4
_LENGTH_M = 16.0
# Aisles of 5 m both ways
_FIRST_M = (6.0, 6.0)
_ACROSS_M = 7.4
_ALONG_M = 21.0
_COLUMNS = 26
_ROWS = 9
_GOODS_M = (1.2, 0.8)  # a pallet on the floor, along the rack and out into the aisle
_SEED = 0

_HEADER = f"""\
# A warehouse of 200 x 200 m for scale, by scripts.make_warehouse (seed {_SEED}): racks back to
# back, pallets on the floor in front of some. The tour goes up and down through every second aisle.
name: warehouse
resolution: 0.05
wall_thickness: 0.20
"""


def warehouse_yaml() -> str:
    """Text of the world file."""
    rng = np.random.default_rng(_SEED)
    solids = []
    for column in range(_COLUMNS):
        for row in range(_ROWS):
            x = _FIRST_M[0] + column * _ACROSS_M
            y = _FIRST_M[1] + row * _ALONG_M
            solids.append(_box(x, y, _RACK_M, _LENGTH_M))
            for at_x in (x - _GOODS_M[1], x + _RACK_M):
                if rng.random() < 0.5:
                    solids.append(
                        _box(at_x, y + rng.uniform(0.0, _LENGTH_M - _GOODS_M[0]), *_GOODS_M[::-1])
                    )
    side = f'{_SIDE_M:g}'
    lines = [
        'walls:',
        f'  - [[0, 0], [{side}, 0], [{side}, {side}], [0, {side}], [0, 0]]',
        'solids:',
    ]
    tour = ', '.join(f'[{x:.5g}, {y:.5g}]' for x, y in _tour())
    return _HEADER + f'start: [3.0, 3.0, 0.0]\ntour: [{tour}]\n' + '\n'.join(lines + solids) + '\n'


def _box(x: float, y: float, width: float, depth: float) -> str:
    corners = [(x, y), (x + width, y), (x + width, y + depth), (x, y + depth)]
    return '  - [' + ', '.join(f'[{a:.5g}, {b:.5g}]' for a, b in corners) + ']'


def _tour() -> list[tuple[float, float]]:
    """Up one aisle and down the next but one, then home along the lower wall."""
    low = 3.0
    high = _SIDE_M - 3.0
    points = []
    for number, column in enumerate(range(0, _COLUMNS - 1, 2)):
        x = _FIRST_M[0] + column * _ACROSS_M + 0.5 * (_RACK_M + _ACROSS_M)
        points += [(x, low), (x, high)] if number % 2 == 0 else [(x, high), (x, low)]
    last = points[-1][0]
    return [*points, (last, low), (3.0, low)] if points[-1][1] == high else [*points, (3.0, low)]


if __name__ == '__main__':
    print(warehouse_yaml(), end='')
