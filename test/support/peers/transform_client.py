"""A client of TF that follows tf2's documented rules, and not our buffer's.

A lookup at a time succeeds where each transform on the way has a sample at that time, or one before
and one after it: there is no extrapolation. Static transforms hold at every time.
"""

from tf2_msgs.msg import TFMessage

from thinmap_ros.ros import messages, qos


class TransformClient:
    """Records the stamps of each transform, and looks up chains of them."""

    def __init__(self, graph, prefix=''):
        self._stamps = {}
        self._parents = {}
        self._static = set()
        graph.node.create_subscription(TFMessage, f'{prefix}/tf', self._on_tf, qos.TRANSFORMS)
        graph.node.create_subscription(
            TFMessage, f'{prefix}/tf_static', self._on_static, qos.STATIC_TRANSFORMS
        )

    def _on_tf(self, message):
        for transform in message.transforms:
            child = transform.child_frame_id
            self._parents[child] = transform.header.frame_id
            self._stamps.setdefault(child, []).append(messages.stamp_ns(transform.header.stamp))

    def _on_static(self, message):
        for transform in message.transforms:
            self._parents[transform.child_frame_id] = transform.header.frame_id
            self._static.add(transform.child_frame_id)

    def chain(self, target, source):
        """Frames from the source up to below the target; None where they are not connected."""
        frames = []
        frame = source
        while frame != target:
            if frame not in self._parents or frame in frames:
                return None
            frames.append(frame)
            frame = self._parents[frame]
        return frames

    def newest_ns(self, child):
        """Stamp of the newest transform to a frame that was received."""
        return max(self._stamps[child])

    def failure(self, target, source, ns):
        """Why a lookup fails; '' where it succeeds."""
        frames = self.chain(target, source)
        if frames is None:
            return f'{source} is not connected to {target}'
        for frame in frames:
            stamps = self._stamps.get(frame, [])
            if frame not in self._static and not (stamps and stamps[0] <= ns <= max(stamps)):
                newest = max(stamps, default=0)
                return f'{frame}: extrapolation, {(ns - newest) / 1e9:.3f} s after the newest'
        return ''
