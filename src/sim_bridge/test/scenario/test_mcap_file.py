# SPDX-License-Identifier: Apache-2.0
"""What is written is read by mcap_ros2, which decodes messages by the definitions in the file."""

import io
from contextlib import closing

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from sim_bridge.mcap_file import McapFile


def filled():
    state = JointState(name=["a", "b"], position=[1.0, -2.0], velocity=[0.1, 0.2], effort=[9.0])
    state.header.stamp.sec, state.header.stamp.nanosec, state.header.frame_id = 3, 7, "base"
    limits = JointTrajectory(joint_names=["a"], points=[JointTrajectoryPoint()] * 2)
    limits.points[0].accelerations = [-3.5]
    status = DiagnosticStatus(level=DiagnosticStatus.WARN, message="é", name="n")
    status.values = [KeyValue(key="k", value="v")]
    pose = PoseWithCovarianceStamped()
    pose.pose.covariance = np.arange(36.0)
    markers = MarkerArray(markers=[Marker(ns="wall", type=Marker.CUBE)])
    text = String(data="x" * 999)
    return [state, limits, DiagnosticArray(status=[status]), pose, markers, text]


def equal(ours, read):
    """Whether a message is what a reader made of it, field by field."""
    if hasattr(ours, "get_fields_and_field_types"):
        fields = ours.get_fields_and_field_types()
        return all(equal(getattr(ours, name), getattr(read, name)) for name in fields)
    if isinstance(ours, bytes):
        return ours[0] == read
    if isinstance(ours, str | int | float):
        return ours == read
    return len(ours) == len(read) and all(map(equal, ours, read))


@pytest.mark.parametrize("message", filled(), ids=lambda message: type(message).__name__)
def test_an_independent_reader_decodes_what_was_written(tmp_path, message):
    path = tmp_path / "one.mcap"
    with closing(McapFile(path)) as file:
        file.add_topic("/topic", type(message))
        file.write("/topic", serialize_message(message), 12_345)
    reader = make_reader(io.BytesIO(path.read_bytes()), decoder_factories=[DecoderFactory()])
    ((_, channel, entry, read),) = reader.iter_decoded_messages()
    assert (channel.topic, entry.log_time) == ("/topic", 12_345)
    assert equal(message, read)
