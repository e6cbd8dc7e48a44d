"""The topics and services of AMCL, in mode localization."""

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav2_msgs.msg import Particle, ParticleCloud
from nav2_msgs.srv import SetInitialPose
from std_srvs.srv import Empty

from thinmap_msgs.srv import LocalizeGlobally
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.stage import Estimate
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.subscription import subscribe_guarded

_SAMPLES = 200
_SHOWN = 1000  # hypotheses of the global localizer


class AmclInterface:
    """amcl_pose and particle_cloud out; AMCL's services.

    amcl_pose: the last known pose: none is published while the robot is lost. particle_cloud:
    samples of the posterior; while the robot is lost, the samples of the global localizer.
    request_nomotion_update publishes both again; scans are matched while the robot stands, too.
    """

    def __init__(
        self,
        node: ThinmapNode,
        map_frame: str,
        set_pose: Callable[[PoseWithCovarianceStamped], None],
    ) -> None:
        """set_pose: takes an initial pose in any frame; raises InputError."""
        self._node = node
        self._map_frame = map_frame
        self._set_pose = set_pose
        self._last: tuple[int, Estimate] | None = None
        self._pose = node.create_publisher(PoseWithCovarianceStamped, 'amcl_pose', qos.LATCHED)
        self._cloud = node.create_publisher(ParticleCloud, 'particle_cloud', qos.SENSOR)
        self._search = node.create_client(LocalizeGlobally, 'localize_globally')
        subscribe_guarded(node, PoseArray, 'localization_samples', self._on_samples, qos.LATCHED)
        node.create_service(SetInitialPose, 'set_initial_pose', self._on_set_pose)
        node.create_service(Empty, 'reinitialize_global_localization', self._on_search)
        node.create_service(Empty, 'request_nomotion_update', self._on_update)

    @property
    def has_published(self) -> bool:
        """Whether there was an estimate in a map."""
        return self._last is not None

    def publish(self, stamp_ns: int, estimate: Estimate) -> None:
        """Publish the estimate of a scan."""
        self._last = (stamp_ns, estimate)
        if estimate.is_lost:
            return
        self._pose.publish(messages.estimate_msg(estimate, self._map_frame, stamp_ns))
        if self._cloud.get_subscription_count():
            self._cloud.publish(self._posterior(stamp_ns, estimate))

    def _posterior(self, stamp_ns: int, estimate: Estimate) -> ParticleCloud:
        rng = np.random.default_rng(stamp_ns)
        samples = rng.multivariate_normal(
            estimate.T_map_base, estimate.covariance, _SAMPLES, check_valid='ignore'
        )
        weight = 1.0 / _SAMPLES
        return ParticleCloud(
            header=messages.header(self._map_frame, stamp_ns),
            particles=[Particle(pose=messages.pose_msg(T), weight=weight) for T in samples],
        )

    def _on_samples(self, message: PoseArray) -> None:
        is_lost = self._last is None or self._last[1].is_lost
        if not (is_lost and message.poses and self._cloud.get_subscription_count()):
            return
        poses = message.poses[:: -(-len(message.poses) // _SHOWN)]
        weight = 1.0 / len(poses)
        self._cloud.publish(
            ParticleCloud(
                header=message.header,
                particles=[Particle(pose=pose, weight=weight) for pose in poses],
            )
        )

    def _on_set_pose(
        self, request: SetInitialPose.Request, response: SetInitialPose.Response
    ) -> SetInitialPose.Response:
        try:
            self._set_pose(request.pose)
        except InputError as error:
            self._node.diagnostics.message_rejected('set_initial_pose', str(error))
            self._node.get_logger().warning(f'set_initial_pose: {error}')
        return response

    def _on_search(self, _: Empty.Request, response: Empty.Response) -> Empty.Response:
        if self._search.service_is_ready():
            self._search.call_async(LocalizeGlobally.Request(discard_hypotheses=True))
        else:
            self._node.get_logger().warning(
                'reinitialize_global_localization: global_localizer is not running'
            )
        return response

    def _on_update(self, _: Empty.Request, response: Empty.Response) -> Empty.Response:
        if self._last is not None:
            self.publish(*self._last)
        return response
