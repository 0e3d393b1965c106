# SPDX-License-Identifier: Apache-2.0
"""What a client makes of the status of controllers, and of states; without ROS."""

import math
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from torque_safety_controller.remote import arm_client
from torque_safety_controller.remote.arm_client import ArmClient, NotReachedError
from viability_bounds_pkg.testing.ros_harness import joint_state


@pytest.fixture
def client(monkeypatch):
    monkeypatch.setattr(arm_client, "_SETTLED", 0.05)
    made = ArmClient.__new__(ArmClient)
    made._joints, made._timeout, made._heard = ["a", "b"], 1.0, {}
    made._status, made._status_at = {}, -math.inf
    made._executor = SimpleNamespace(spin_once=lambda timeout_sec: None)
    return made


def arrive(client, *told):
    """Wait until all statuses, of node and refused goals, have been told."""
    left = list(told)

    def there():
        if not left:
            return True
        name, refused = left.pop(0)
        values = [KeyValue(key="goals_refused", value=refused)]
        client._on_diagnostics(
            DiagnosticArray(status=[DiagnosticStatus(name=name, values=values)])
        )
        return False

    client._arrive(there, 10.0)


def test_only_the_status_of_its_own_controller_counts(client):
    arrive(client, ("controller_node", "none"))
    arrive(client, ("left/controller_node", "target_pose: 1;"), ("controller_node", "none"))
    with pytest.raises(NotReachedError, match="refused it: target_pose: 1;"):
        arrive(client, ("controller_node", "target_pose: 1;"))


def test_a_controller_that_starts_again_has_refused_nothing(client):
    with pytest.raises(NotReachedError, match="refused it"):
        arrive(client, ("controller_node", "none"), ("controller_node", "target_pose: 1;"))
    arrive(client, ("controller_node", "none"))


def test_a_controller_that_has_gone_is_told(client):
    client._on_diagnostics(DiagnosticArray(status=[DiagnosticStatus(name="controller_node")]))
    with pytest.raises(NotReachedError, match="the controller is silent"):
        client._arrive(lambda: False, 10.0)


def test_a_joint_that_the_robot_does_not_have_is_named(client):
    message = joint_state(["a", "bb"], 1, [0.0, 0.0])
    client._executor.spin_once = lambda timeout_sec: client._heard.update(
        dict.fromkeys(("joint_states", "hand_pose", "limit_distances"), message)
    )
    with pytest.raises(NotReachedError, match="does not tell where 'b' is; did you mean 'bb'?"):
        client.state()
