"""Draws explorations, of one robot or two, as GIFs.

    python scripts/moving_picture.py exploration [WORLD] [-o docs/images/exploration.gif]
    python scripts/moving_picture.py team [WORLD] [-o docs/images/two_robots.gif]

`exploration` explores a simulated world with SLAM, as explore_world does, and draws a frame every
few seconds of simulated time: occupancy map, topological graph, path, robot and laser. The first
frame is the finished one, which is all that is seen where pictures do not move.
`team` does so with two robots that explore together, as explore_world --robots 2.
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from thinmap_ros.closed_loop.loop import ClosedLoop, make_loop, no_progress
from thinmap_ros.closed_loop.robot import SCANS_PER_GRAPH, Options, SimulatedRobot
from thinmap_ros.core import se2
from thinmap_ros.core.exploration.strategy import Decision, Strategy
from thinmap_ros.core.grid.occupancy import OccupancyConfig
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.files.package_data import world_path
from thinmap_ros.files.safe import atomic_write
from thinmap_ros.files.worlds import read_world
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.coverage import observable_cells
from thinmap_ros.sim.other_robots import starts_side_by_side
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World
from thinmap_ros.view import palette

IMAGES = Path(__file__).resolve().parents[1] / 'docs' / 'images'
WIDTH_PX = 800
MARGIN_M = 0.3
CAPTION_PX = 24  # of the caption, and of the key below it
KEY_GAP_PX = 14
SMOOTHING = 2  # frames are drawn this many times as large
SCANS_PER_FRAME = 12
FRAME_MS = 100
FIRST_FRAME_MS = 1500
LAST_FRAME_MS = 3000
TEAM = 2
LIMIT_S = 3600.0
GREY = '#CCCCCC'
PLAN = '#D55E00'
ROBOT = '#0072B2'
LASER = '#56B4E938'
OBSERVED = '#DAEEF9'  # the laser's colour on white
PATH = palette.ESTIMATE
WHITE = '#FFFFFF'
BLACK = '#000000'
KEY = {
    'wall': BLACK,
    'free': WHITE,
    'unknown': GREY,
    'laser': OBSERVED,
    'graph': palette.EDGE,
    **{f'{kind.name.lower()} node': colour for kind, colour in palette.NODES.items()},
}


class Canvas:
    """A picture of a rectangle of the map frame, with a caption below it."""

    def __init__(self, low: Array, high: Array) -> None:
        self.low = low
        self.high = high
        self.scale = SMOOTHING * WIDTH_PX / (high[0] - low[0])
        height_px = round((high[1] - low[1]) * self.scale) + 2 * SMOOTHING * CAPTION_PX
        self.image = Image.new('RGB', (SMOOTHING * WIDTH_PX, height_px), WHITE)
        self.draw = ImageDraw.Draw(self.image, 'RGBA')

    def pixels(self, points: Array) -> list[tuple[float, float]]:
        """Pixels of points (N, 2) in m."""
        x = (points[:, 0] - self.low[0]) * self.scale
        y = (self.high[1] - points[:, 1]) * self.scale
        return list(zip(x.tolist(), y.tolist(), strict=True))

    def line(self, points: Array, colour: str, width: float) -> None:
        """Draw a polyline (N, 2) of a width in pixels."""
        if len(points) > 1:
            width_px = round(SMOOTHING * width)
            self.draw.line(self.pixels(points), fill=colour, width=width_px, joint='curve')

    def disc(self, point: Array, radius_px: float, colour: str) -> None:
        """Draw a disc with a dark edge."""
        ((x, y),) = self.pixels(point[None, :2])
        radius = SMOOTHING * radius_px
        box = (x - radius, y - radius, x + radius, y + radius)
        self.draw.ellipse(box, fill=colour, outline=BLACK, width=SMOOTHING // 2)

    @property
    def bottom_px(self) -> int:
        """Lower edge of the map."""
        return self.image.height - 2 * CAPTION_PX * SMOOTHING

    def caption(self, text: str) -> None:
        """Write a line below the map."""
        place = (6 * SMOOTHING, self.bottom_px)
        self.draw.text(place, text, fill=BLACK, font=font(16 * SMOOTHING))

    def key(self, colours: Mapping[str, str]) -> None:
        """Write what each colour means below the caption."""
        letters = font(13 * SMOOTHING)
        left = 6.0 * SMOOTHING
        top = self.bottom_px + CAPTION_PX * SMOOTHING
        edge = 10 * SMOOTHING
        for name, colour in colours.items():
            box = (left, top + 3 * SMOOTHING, left + edge, top + 3 * SMOOTHING + edge)
            self.draw.rectangle(box, fill=colour, outline=BLACK, width=SMOOTHING // 2)
            left += edge + 4 * SMOOTHING
            self.draw.text((left, top), name, fill=BLACK, font=letters)
            left += letters.getlength(name) + KEY_GAP_PX * SMOOTHING

    def smoothed(self) -> Image.Image:
        """The picture in its final size."""
        size = (WIDTH_PX, round(self.image.height / SMOOTHING))
        return self.image.resize(size, Image.Resampling.LANCZOS)


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """The font of matplotlib, which is everywhere the same."""
    return ImageFont.truetype(font_manager.findfont('DejaVu Sans'), size)


def map_image(patch: GridPatch) -> Image.Image:
    """One pixel for each cell: free white, occupied black, unknown grey; north is up."""
    shades = np.full(patch.shape, palette.rgb(GREY)[0], dtype=np.uint8)
    shades[patch.free] = 255
    shades[patch.occupied] = 0
    return Image.fromarray(shades[::-1])


def paste_map(canvas: Canvas, patch: GridPatch) -> None:
    """Draw the cells of a grid; the rest of the picture is unknown."""
    rows, cols = patch.shape
    frame = patch.frame
    top = np.array([[frame.origin_x, frame.origin_y + rows * frame.resolution]])
    ((left_px, top_px),) = canvas.pixels(top)
    size = [round(count * frame.resolution * canvas.scale) for count in (cols, rows)]
    cells = map_image(patch).resize((size[0], size[1]), Image.Resampling.NEAREST)
    bottom_px = canvas.bottom_px
    canvas.draw.rectangle((0, 0, canvas.image.width, bottom_px), fill=GREY)
    canvas.image.paste(cells, (round(left_px), round(top_px)))
    canvas.draw.rectangle((0, bottom_px, canvas.image.width, canvas.image.height), fill=WHITE)


def draw_graph(canvas: Canvas, topology: TopologicalMap) -> None:
    """Draw the paths of the edges, and the nodes by kind."""
    for edge in topology.edges.values():
        canvas.line(edge.path, palette.EDGE, 2.0)
    for node in topology.nodes.values():
        canvas.disc(node.position, 4.0, palette.NODES[node.kind])


def draw_laser(canvas: Canvas, scan: Scan, T_map_base: Array) -> None:
    """Draw the area that a scan has observed."""
    x, y, heading = se2.compose(T_map_base, scan.T_base_laser)
    ranges = np.where(scan.valid, np.minimum(scan.ranges_m, scan.range_max_m), 0.0)
    bearings = heading + scan.angles_rad
    ends = np.column_stack([x + ranges * np.cos(bearings), y + ranges * np.sin(bearings)])
    canvas.draw.polygon(canvas.pixels(np.vstack([[[x, y]], ends])), fill=LASER)


def draw_robot(canvas: Canvas, T_map_base: Array, radius_m: float, colour: str = ROBOT) -> None:
    """Draw the robot and its heading."""
    canvas.disc(T_map_base, radius_m * canvas.scale / SMOOTHING, colour)
    x, y, heading = T_map_base
    front = (x + radius_m * math.cos(heading), y + radius_m * math.sin(heading))
    canvas.line(np.array([[x, y], front]), WHITE, 2.0)


def shown_area(world: World) -> tuple[Array, Array]:
    """Lower left and upper right corner, m, of a picture that shows all walls."""
    rows, cols = np.nonzero(world.occupied)
    walls = world.frame.centres_of(np.column_stack([rows, cols]))
    return walls.min(axis=0) - MARGIN_M, walls.max(axis=0) + MARGIN_M


class Film(Strategy):
    """A strategy that draws a frame of every few scans and leaves the decisions to another one."""

    def __init__(self, world: World, robot: SimulatedRobot) -> None:
        self.low, self.high = shown_area(world)
        self.robot = robot
        self.strategy = robot.mission.strategy
        self.images: list[Image.Image] = []
        self._scans = 0

    def step(
        self, topology: TopologicalMap, patch: GridPatch, scan: Scan, T_map_base: Array
    ) -> Decision:
        """Decide, and draw the frame that is due; the last one always."""
        decision = self.strategy.step(topology, patch, scan, T_map_base)
        if self._scans % SCANS_PER_FRAME == 0 or decision.finished:
            self.images.append(self._image(topology, patch, scan, T_map_base, decision))
        self._scans += 1
        return decision

    def target_failed(self, reason: str) -> None:
        """Report a failed drive to the strategy that decides."""
        self.strategy.target_failed(reason)

    def _image(
        self,
        topology: TopologicalMap,
        patch: GridPatch,
        scan: Scan,
        T_map_base: Array,
        decision: Decision,
    ) -> Image.Image:
        canvas = Canvas(self.low, self.high)
        paste_map(canvas, patch)
        if not decision.finished:
            draw_laser(canvas, scan, T_map_base)
        path = np.array(self.robot.log.poses)[:, :2]
        draw_graph(canvas, topology)
        canvas.line(path, PATH, 2.5)
        plan = self.robot.navigator.path
        if plan is not None and decision.target is not None:
            canvas.line(plan[:, :2], PLAN, 1.5)
            canvas.disc(decision.target.goal, 3.5, WHITE)
        draw_robot(canvas, T_map_base, self.robot.radius_m)
        driven_m = np.hypot(*np.diff(path, axis=0).T).sum()
        text = f'{scan.stamp_ns / 1e9:.0f} s   {driven_m:.0f} m driven   '
        text += f'{decision.known_area_m2:.0f} m² known'
        canvas.caption(f'{text}   exploration finished' if decision.finished else text)
        canvas.key(KEY | {'path': PATH, 'plan': PLAN, 'robot': ROBOT})
        return canvas.smoothed()


def explore_on_film(world: World, options: Options) -> list[Image.Image]:
    """Explore a world with SLAM; returns a picture of every few seconds of simulated time."""
    loop = make_loop(world, [world.start], options)
    (robot,) = loop.robots
    robot.pipeline = fine_pipeline(world.start, options)
    film = Film(world, robot)
    robot.mission.strategy = film
    goal = observable_cells(world, world.start, robot.radius_m, options.laser.range_max_m)
    outcome = loop.run(goal, options.time_limit_s, no_progress)
    print(f'{world.name}: {outcome.reason}, {len(film.images)} frames')
    return film.images


def explore_together_on_film(world: World, options: Options, count: int) -> list[Image.Image]:
    """Explore a world with several robots; returns a picture of every few seconds."""
    radius_m = PRESETS[options.robot].radius_m
    starts = starts_side_by_side(world, world.start, count, radius_m)
    loop = make_loop(world, starts, options)
    low, high = shown_area(world)
    images: list[Image.Image] = []

    def show(seconds: float, _: float) -> None:
        images.append(team_image(loop, Canvas(low, high), seconds))

    goal = observable_cells(world, world.start, radius_m, options.laser.range_max_m)
    outcome = loop.run(goal, options.time_limit_s, show, SCANS_PER_FRAME)
    print(f'{world.name}: {outcome.reason}, {len(images)} frames')
    return images


def team_image(loop: ClosedLoop, canvas: Canvas, seconds: float) -> Image.Image:
    """The joint map and graph, and the path of each robot."""
    patch = loop.maps.known_area()
    paste_map(canvas, patch)
    for robot in loop.robots:
        if robot.moment.scans and not loop.is_finished:
            draw_laser(canvas, robot.moment.scans[0], robot.pose)
    draw_graph(canvas, loop.maps.view(0)[0])
    driven_m = 0.0
    for robot, colour in zip(loop.robots, palette.ROBOTS, strict=False):
        path = np.array(robot.log.poses)[:, :2]
        driven_m += float(np.hypot(*np.diff(path, axis=0).T).sum())
        canvas.line(path, colour, 2.5)
        draw_robot(canvas, robot.pose, robot.radius_m, colour)
    known_m2 = float(patch.free.sum()) * patch.frame.resolution**2
    text = f'{seconds:.0f} s   {driven_m:.0f} m driven   {known_m2:.0f} m² known'
    canvas.caption(f'{text}   exploration finished' if loop.is_finished else text)
    robots = zip(loop.robots, palette.ROBOTS, strict=False)
    canvas.key(KEY | {f'robot {i}': colour for i, (_, colour) in enumerate(robots, 1)})
    return canvas.smoothed()


def fine_pipeline(start: Array, options: Options) -> Pipeline:
    """The pipeline of an exploration in the simulator, with cells of 5 cm."""
    x, y, yaw = (float(number) for number in start)
    localizer = LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)
    grid = OccupancyConfig(no_return_clear_range_m=options.laser.range_max_m)
    return Pipeline(PipelineConfig(localizer=localizer, grid=grid, scans_per_graph=SCANS_PER_GRAPH))


def gif_palette(drawn: Sequence[str]) -> Image.Image:
    """The colours of a frame, pure and blended with what is below them, as smoothing needs it."""
    grounds = [np.array(palette.rgb(colour)) for colour in (WHITE, BLACK, GREY, OBSERVED)]
    colours = dict.fromkeys([*drawn, palette.EDGE, *palette.NODES.values()])
    inks = [*grounds, *(np.array(palette.rgb(colour)) for colour in colours)]
    blends = {
        tuple(np.rint(ground + share * (ink - ground)).astype(int).tolist())
        for ink in inks
        for ground in grounds
        for share in (0.25, 0.5, 0.75, 1.0)
    }
    picture = Image.new('P', (1, 1))
    picture.putpalette([channel for colour in sorted(blends) for channel in colour])
    return picture


def write_gif(path: Path, images: list[Image.Image], drawn: Sequence[str]) -> None:
    """Write an endless loop that begins with its end; drawn: colours beside the graph's."""
    colours = gif_palette(drawn)
    frames = [image.quantize(palette=colours, dither=Image.Dither.NONE) for image in images]
    frames.insert(0, frames[-1])
    durations = [FIRST_FRAME_MS] + [FRAME_MS] * (len(frames) - 2) + [LAST_FRAME_MS]
    with atomic_write(path) as aside:
        frames[0].save(
            aside,
            format='GIF',
            save_all=True,
            append_images=frames[1:],
            duration=durations,
            loop=0,
            optimize=True,
        )


def write_exploration(arguments: argparse.Namespace) -> None:
    """Explore a world and write the GIF."""
    world = World.from_patch(*read_world(world_path(arguments.world)))
    options = Options(localization='slam', seed=arguments.seed, time_limit_s=LIMIT_S)
    write_gif(arguments.out, explore_on_film(world, options), (PLAN, ROBOT, PATH))


def write_team(arguments: argparse.Namespace) -> None:
    """Explore a world with two robots and write the GIF."""
    world = World.from_patch(*read_world(world_path(arguments.world)))
    options = Options(seed=arguments.seed, time_limit_s=LIMIT_S)
    images = explore_together_on_film(world, options, TEAM)
    write_gif(arguments.out, images, palette.ROBOTS[:TEAM])


def main() -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    exploration = commands.add_parser('exploration', help='a GIF of an exploration with SLAM')
    exploration.add_argument('world', nargs='?', default='lab', help='a world (default: lab)')
    exploration.add_argument('-o', '--out', type=Path, default=IMAGES / 'exploration.gif')
    exploration.add_argument('--seed', type=int, default=0, help='decides all noise (default 0)')
    exploration.set_defaults(work=write_exploration)
    team = commands.add_parser('team', help='a GIF of an exploration by two robots')
    team.add_argument('world', nargs='?', default='lab', help='a world (default: lab)')
    team.add_argument('-o', '--out', type=Path, default=IMAGES / 'two_robots.gif')
    team.add_argument('--seed', type=int, default=0, help='decides all noise (default 0)')
    team.set_defaults(work=write_team)
    arguments = parser.parse_args()
    arguments.work(arguments)


if __name__ == '__main__':
    main()
