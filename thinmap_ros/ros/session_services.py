"""A session saved and loaded across nodes: each node saves and loads its own part when asked.

It may save it at its end, too. Services read and write in one directory.
"""

import shutil
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.node import Node

from thinmap_msgs.srv import LoadMap, SaveMap
from thinmap_ros.core.errors import InputError, ThinmapError, quoted
from thinmap_ros.files.safe import FILES
from thinmap_ros.files.sessions import (
    ENDINGS,
    EXPLORATION,
    LOCALIZER,
    TOPOLOGY,
    SessionPart,
    require_own_files,
    saved_with,
    stem_of,
)
from thinmap_ros.ros import parameters
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.services import call, offer
from thinmap_ros.ros.time_jumps import STEADY

Part = SessionPart[Any, Any]
_SAVED: tuple[Part, ...] = (TOPOLOGY, LOCALIZER, EXPLORATION)
_LOADED: tuple[Part, ...] = (TOPOLOGY, LOCALIZER)


# A peer that saves again and again neither fills the disk nor keeps the node from its work.
_MAX_SAVES = 20
_PERIOD_S = 60.0
_MIN_FREE_BYTES = 100 << 20


class SaveDirectory:
    """The directory in which the services of a node may read and write, symbolic links resolved.

    Any caller of a service can name a path. Paths that the operator gives when starting a node,
    as parameters, are not confined.
    """

    def __init__(self, node: Node) -> None:
        """Declare the parameter `save_directory`; empty: the working directory of the node."""
        description = (
            'Directory that save and load services are confined to. Empty: the working directory.'
        )
        given = parameters.declare_parameter(node, 'save_directory', '', description)
        self.path = Path(str(given)).resolve()
        self._saves_s: deque[float] = deque(maxlen=_MAX_SAVES)

    def resolve_for_saving(self, given: str, part: Part) -> str:
        """Absolute path of a session to which a service is to save a part.

        Raises InputError as `resolve`, where a file exists that thinmap has not written, after too
        many saves in a minute, and where the disk is almost full.
        """
        path = self.resolve(given)
        require_own_files(path, part)
        now_s = time.monotonic()
        if len(self._saves_s) == _MAX_SAVES and now_s - self._saves_s[0] < _PERIOD_S:
            raise InputError(
                f'path {quoted(given)}: {_MAX_SAVES} saves within {_PERIOD_S:.0f} s: '
                'expected fewer; save again in a minute'
            )
        free = shutil.disk_usage(self.path).free
        if free < _MIN_FREE_BYTES:
            raise InputError(
                f'path {quoted(given)}: {free} bytes free on the disk: '
                f'expected {_MIN_FREE_BYTES} at least'
            )
        self._saves_s.append(now_s)
        return path

    def resolve(self, given: str) -> str:
        """Absolute path of a session that a service names, links resolved.

        Raises InputError where it, or a file of the session, is outside of this directory.
        """
        expected = f'expected a file below {self.path}'
        if not given.isprintable() or len(given) > FILES.path_length:
            raise InputError(f'path {quoted(given)}: {expected}')
        stem_of(given)  # raises for a path that names no session
        try:
            resolved = (self.path / given).resolve()
            stem = stem_of(str(resolved))
            files = [stem.with_name(stem.name + ending).resolve() for ending in ENDINGS]
        except (OSError, RuntimeError) as error:  # RuntimeError: links that lead in a circle
            raise InputError(f'path {quoted(given)}: {error}: {expected}') from error
        for file in (resolved, *files):
            if not file.is_relative_to(self.path) or file == self.path:
                raise InputError(f'path {quoted(given)}: {expected}')
        return str(resolved)


def offer_saving(
    node: ThinmapNode,
    directory: SaveDirectory,
    part: Part,
    save: Callable[[str, bool], str],
    save_at_end: Callable[[str], str],
) -> None:
    """Offer service save_PART, and declare the parameters of `save_on_exit`.

    save: gets path and overwrite, returns what was saved; save_at_end: as of `save_on_exit`.
    """

    def work(request: SaveMap.Request) -> str:
        return save(directory.resolve_for_saving(request.path, part), request.overwrite)

    offer(node.create_active_service, SaveMap, f'save_{part.name}', work)
    save_on_exit(node, directory, part, save_at_end)


def offer_loading(
    node: ThinmapNode, part: Part, check: Callable[[str], str], load: Callable[[str], str]
) -> None:
    """Offer services check_PART and load_PART; check, load: get the path as it was given."""
    create = node.create_service
    offer(create, LoadMap, f'check_{part.name}', lambda request: check(request.path))
    offer(create, LoadMap, f'load_{part.name}', lambda request: load(request.path))


def save_on_exit(
    node: ThinmapNode, directory: SaveDirectory, part: Part, save: Callable[[str], str]
) -> None:
    """Save a part of the session of `save_on_exit` when the node ends, and now and then before.

    save: gets a path, returns what was saved, '' for nothing: a node without a map saves none.
    Raises InputError where the parameter names no path below the directory, or a file that is not
    of thinmap.
    """
    given = parameters.declare_parameter(
        node,
        'save_on_exit',
        '',
        'Path stem of the session that is saved when the node ends, below save_directory. '
        'Empty: none. Give it to localizer, grid_mapper, topology_builder and explorer.',
    )
    period_s = parameters.declare_parameter(
        node,
        'autosave_period_s',
        0.0,
        'Time after which the session of save_on_exit is saved again (s). 0: only at the '
        'end. Set it where the power may fail.',
        low=0.0,
    )
    if not given:
        return
    path = directory.resolve(str(given))
    require_own_files(path, part)

    def save_now() -> None:
        try:
            if saved := save(path):
                node.get_logger().info(saved)
        except (ThinmapError, OSError) as error:
            node.get_logger().error(f'save_on_exit: {error}')

    node.add_end_callback(save_now)
    if float(period_s) > 0.0:
        node.create_timer(float(period_s), save_now, clock=STEADY)


class SessionClient:
    """Asks the nodes that share a session with `node` to save or load their parts."""

    def __init__(self, node: Node, callback_group: CallbackGroup) -> None:
        """Create the clients; callback_group: one that a waiting callback does not block."""

        def client(kind: Any, verb: str, part: Part) -> Client:
            return node.create_client(kind, f'{verb}_{part.name}', callback_group=callback_group)

        self._node = node
        self._save = {part.name: client(SaveMap, 'save', part) for part in _SAVED}
        self._check = {part.name: client(LoadMap, 'check', part) for part in _LOADED}
        self._load = {part.name: client(LoadMap, 'load', part) for part in _LOADED}

    async def save(self, path: str, overwrite: bool) -> SaveMap.Response:
        """Save the parts of all other nodes; overwrite: as in SaveMap.

        The part of a node that is not running is archived, as it belongs to an earlier session,
        unless saving has failed before.
        """
        stem = str(stem_of(path))
        result = SaveMap.Response(success=True)
        for part in _SAVED:
            request = SaveMap.Request(path=stem, overwrite=overwrite)
            result = joined(result, await self._save_part(part, request, result.success))
        return result

    async def load(self, path: str, load_grid: Callable[[], None]) -> LoadMap.Response:
        """Load graph, grid and localizer, after each node has checked its part, or nothing.

        A session without a graph clears the graph of the builder.
        Raises InputError where the path names no session.
        """
        stem = str(stem_of(path))
        paths = {part.name: stem for part in _LOADED}
        if not TOPOLOGY.exists(stem):
            paths[TOPOLOGY.name] = ''
        for part in _LOADED:
            checked = await self._check_part(part, paths[part.name])
            if not checked.success:
                return checked
        graph = await self._load_part(TOPOLOGY, paths[TOPOLOGY.name])
        if not graph.success:  # the file was replaced since
            return graph
        load_grid()
        maps = joined(LoadMap.Response(success=True, message='grid loaded'), graph)
        return joined(maps, await self._load_part(LOCALIZER, stem))

    async def _check_part(self, part: Part, stem: str) -> LoadMap.Response:
        """Have a node read its part; success where it is not running."""
        client = self._check[part.name]
        answer = await call(self._node, client, LoadMap.Request(path=stem))
        if answer is None and self._load[part.name].service_is_ready():
            later = f'{client.srv_name}: not found yet: expected a moment later'
            return LoadMap.Response(success=False, message=later)
        return answer or LoadMap.Response(success=True)

    async def _save_part(
        self, part: Part, request: SaveMap.Request, archives: bool
    ) -> SaveMap.Response:
        answer = await call(self._node, self._save[part.name], request)
        if answer is not None:
            return answer
        try:
            archived = _archived(part, request.path) if archives else ''
        except (ThinmapError, OSError) as error:
            return SaveMap.Response(success=False, message=str(error))
        absent = _absent(part)
        return SaveMap.Response(
            success=True, message=f'{absent}: {archived}' if archived else absent
        )

    async def _load_part(self, part: Part, stem: str) -> LoadMap.Response:
        answer = await call(self._node, self._load[part.name], LoadMap.Request(path=stem))
        return answer or LoadMap.Response(success=True, message=_absent(part))


def _archived(part: Part, stem: str) -> str:
    done = [each.archive(stem) for each in saved_with(part)]
    return ', '.join(text for text in done if text)


def _absent(part: Part) -> str:
    return f'{part.node} is not running'


def joined(a: Any, b: Any) -> Any:
    """One response of two of the same service: success if both have it, and both messages."""
    message = '; '.join(message for message in (a.message, b.message) if message)
    return type(a)(success=a.success and b.success, message=message)
