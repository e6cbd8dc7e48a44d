"""A small room with two niches: nobody sees one of them from the other."""

NICHES = """
name: niches
resolution: 0.02
wall_thickness: 0.10
start: [3.6, 1.4, 1.5707963]
walls:
  - [[0, 0], [8, 0], [8, 4], [0, 4], [0, 0]]
  - [[2, 0], [2, 2.6]]
  - [[6, 0], [6, 2.6]]
"""
START = '3.6,1.4,1.5707963'


def write_niches(folder):
    """Its file, a world of the simulation."""
    path = folder / 'niches.yaml'
    path.write_text(NICHES)
    return path
