"""Where the simulated robots start: as given, as in the file of the world, or side by side."""

from pathlib import Path

from thinmap_ros.core import se2
from thinmap_ros.core.errors import ConfigError, quoted
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.worlds import read_starts
from thinmap_ros.sim.other_robots import starts_in, starts_side_by_side
from thinmap_ros.sim.world import World


def robot_starts(
    world: World, file: Path, count: int, given: tuple[str, str], radius_m: float
) -> list[Array]:
    """Start (3,) of each robot of a radius.

    file: of the world; given: the parameters start and starts.
    Raises ConfigError where these are wrong, InputError where there is no room.
    """
    start, starts = given
    if start and starts:
        raise ConfigError('start and starts: expected one of the two')
    if starts:
        poses = poses_from('starts', starts)
        if len(poses) != count:
            raise ConfigError(
                f'starts = {quoted(starts)}: expected as many as robots ({count}), found '
                f'{len(poses)}'
            )
        return poses
    if start:
        return starts_side_by_side(world, _pose('start', start), count, radius_m)
    listed = read_starts(file)
    if not se2.is_finite(world.start) and not len(listed) >= count > 1:
        raise ConfigError(f'start: world {world.name} has none: expected "x,y,theta"')
    return starts_in(world, world.start, listed, count, radius_m)


def poses_from(name: str, text: str) -> list[Array]:
    """Poses (3,) of a parameter like "x,y,theta; x,y,theta". Raises ConfigError."""
    return [_pose(name, part) for part in text.split(';')]


def _pose(name: str, text: str) -> Array:
    try:
        x, y, theta = (float(part) for part in text.split(','))
        start = se2.pose(x, y, theta)
    except ValueError:
        start = se2.pose(0.0, 0.0, float('nan'))
    if not se2.is_finite(start):
        raise ConfigError(f'{name} = {quoted(text)}: expected "x,y,theta" in m, m, rad')
    return start
