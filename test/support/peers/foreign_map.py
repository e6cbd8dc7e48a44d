"""Maps as other programs write them: by the rules of map_server, not by our writer."""

import numpy as np

from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world

CELL_M = 0.05


def write_foreign_map(folder, world, name='drawn'):
    """NAME.pgm (P5 with a comment) and NAME.yaml of the true walls of a world; path of the YAML."""
    _, patch, _ = read_world(package_data.world_path(world))
    frame = patch.frame
    edge = frame.resolution
    rows, cols = patch.shape
    grey = np.full((int(rows * edge / CELL_M) + 1, int(cols * edge / CELL_M) + 1), 205, np.uint8)
    for cells, value in ((patch.free, 254), (patch.occupied, 0)):
        at = np.argwhere(cells)
        grey[tuple(((at + 0.5) * edge / CELL_M).astype(int).T)] = value
    height, width = grey.shape
    head = f'P5\n# CREATOR: GIMP PNM Filter Version 1.1\n{width} {height}\n255\n'
    (folder / f'{name}.pgm').write_bytes(head.encode() + grey[::-1].tobytes())
    (folder / f'{name}.yaml').write_text(
        f'image: {name}.pgm\nresolution: {CELL_M}\n'
        f'origin: [{frame.origin_x:.6f}, {frame.origin_y:.6f}, 0.000000]\n'
        'negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n'
    )
    return folder / f'{name}.yaml'
