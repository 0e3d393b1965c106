# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from torque_safety_controller.safety.handover import (
    PATIENCE,
    REST_PATIENCE,
    REST_SPEED,
    TORQUE_ERROR,
    Control,
    Handover,
    HandoverRefused,
)

JOINTS = ("a", "b", "c")
Q_MIN, Q_MAX = np.array([-1.0, -np.inf, 0.0]), np.array([1.0, np.inf, 2.0])
TAU_MAX = np.array([10.0, 20.0, 30.0])
REST = np.zeros(3)
Q, TAU = np.array([0.5, 9.0, 1.0]), np.array([-10.0, 20.0, 0.0])


def make(control="position") -> Handover:
    return Handover(control, JOINTS, Q_MIN, Q_MAX, TAU_MAX, 0.01)


def taking_over() -> Handover:
    handover = make()
    handover.hold(Q)
    handover.to_torque(Q, TAU, True, True)
    return handover


def with_torque() -> Handover:
    handover = taking_over()
    handover.taken_over()
    return handover


def test_from_position_to_torque_and_back():
    handover = make()
    assert handover.by_drives
    handover.to_torque(Q, TAU, True, True)
    assert handover.control is Control.TAKING_OVER
    assert handover.by_drives, "one more step is theirs"
    handover.taken_over()
    assert not handover.by_drives
    handover.to_position(Q + 0.1, REST, True)
    assert handover.control is Control.POSITION
    np.testing.assert_array_equal(handover.hold(Q), Q + 0.1)


def test_it_begins_as_told():
    assert make("torque").control is Control.TORQUE
    assert make("position").control is Control.POSITION
    with pytest.raises(ValueError, match="drives"):
        make("drives")


def test_the_position_is_captured_once_and_copied():
    handover = make()
    q = Q.copy()
    handover.hold(q)
    q += 1.0
    np.testing.assert_array_equal(handover.hold(q), Q)
    # Neither asking for torque nor a handover that fails lets the drives' goal creep.
    handover.to_torque(Q, TAU, True, True)
    np.testing.assert_array_equal(handover.hold(q), Q)
    handover.failed("a reason")
    np.testing.assert_array_equal(handover.hold(q), Q)
    assert handover.reason == "handover failed: a reason"
    # Nor does calling it off.
    handover.to_torque(Q, TAU, True, True)
    handover.to_position(q, REST, True)
    np.testing.assert_array_equal(handover.hold(q), Q)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"fresh": False}, "no joint state"),
        ({"bounds_fresh": False}, "no acceleration limits"),
        ({"q": np.array([1.001, 9.0, 1.0])}, "outside the position limits: a"),
        ({"q": np.array([-1.5, -1e6, -0.1])}, "outside the position limits: a, c"),
        ({"tau": None}, "no motor torque"),
        ({"tau": np.array([-10.2, 0.0, 30.4])}, "beyond torque_max: a, c"),
    ],
)
def test_torque_is_refused_with_the_reason_and_nothing_changes(changed, reason):
    arguments = {"q": Q, "tau": TAU, "fresh": True, "bounds_fresh": True}
    handover = make()
    with pytest.raises(HandoverRefused, match=reason):
        handover.to_torque(**arguments | changed)
    assert handover.control is Control.POSITION
    handover.to_torque(**arguments)


def test_what_a_sensor_adds_to_full_torque_is_tolerated():
    make().to_torque(Q, 1.005 * TAU, True, True)


def test_what_is_on_already_is_refused():
    with pytest.raises(HandoverRefused, match="torque control is on already"):
        with_torque().to_torque(Q, TAU, True, True)
    with pytest.raises(HandoverRefused, match="position control is on already"):
        make().to_position(Q, REST, True)


def test_position_is_refused_where_nobody_knows_it():
    handover = with_torque()
    with pytest.raises(HandoverRefused, match="no joint state"):
        handover.to_position(Q, REST, False)
    assert handover.control is Control.TORQUE


@pytest.mark.parametrize(
    ("handover", "control"),
    [
        (make("torque"), Control.TORQUE),
        (make("position"), Control.POSITION),
        (taking_over(), Control.POSITION),
        (with_torque(), Control.POSITION),
    ],
)
def test_a_robot_that_was_away_does_not_get_torque_unasked(handover, control):
    handover.robot_was_away()
    assert handover.control is control
    np.testing.assert_array_equal(handover.hold(Q + 0.2), Q + 0.2)


def test_an_arm_that_was_given_to_its_drives_is_left_to_them():
    handover = make("torque")
    handover.to_position(Q, REST, True)
    handover.robot_was_away()
    assert handover.control is Control.POSITION


def giving_back() -> Handover:
    handover = with_torque()
    handover.to_position(Q, np.array([0.0, -1.0, 0.0]), True)
    return handover


def test_an_arm_in_motion_comes_to_rest_before_the_drives_take_it():
    handover = giving_back()
    assert handover.control is Control.GIVING_BACK
    assert not handover.by_drives
    handover.slow_down(Q + 0.1, np.array([0.0, -1.1 * REST_SPEED, 0.0]), 0.1)
    assert handover.control is Control.GIVING_BACK
    handover.slow_down(Q + 0.2, np.array([0.0, 0.9 * REST_SPEED, 0.0]), 0.1)
    assert handover.control is Control.POSITION
    np.testing.assert_array_equal(handover.hold(Q), Q + 0.2)


def test_an_arm_that_does_not_come_to_rest_is_not_waited_for_for_ever():
    handover = giving_back()
    handover.slow_down(Q, np.ones(3), REST_PATIENCE)
    assert handover.control is Control.GIVING_BACK
    handover.slow_down(Q, np.ones(3), 0.01)
    assert handover.control is Control.POSITION


def test_giving_back_can_be_called_off_and_ends_when_the_robot_was_away():
    handover = giving_back()
    with pytest.raises(HandoverRefused, match="position control is on already"):
        handover.to_position(Q, REST, True)
    handover.to_torque(Q, TAU, True, True)
    assert handover.control is Control.TORQUE
    handover = giving_back()
    handover.robot_was_away()
    assert handover.control is Control.POSITION


def test_a_torque_without_noise_is_known_from_the_state_after_the_call():
    np.testing.assert_array_equal(taking_over().average(Q, TAU), TAU)


def test_noise_is_averaged_until_the_mean_is_known_well_enough():
    random = np.random.default_rng(1)
    handover, tau, waited = make(), None, 0
    handover.to_torque(Q, TAU + 0.005 * TAU_MAX, True, True)
    while tau is None:
        tau = handover.average(Q, TAU + 0.005 * TAU_MAX * random.standard_normal(3))
        waited += 1
    assert 10 < waited < 100
    assert handover.torque.samples == waited + 1
    assert (np.abs(tau - TAU) <= TORQUE_ERROR * TAU_MAX).all()
    assert (handover.torque.error <= TORQUE_ERROR).all()


def test_a_torque_that_stays_unknown_is_refused_after_some_time():
    random = np.random.default_rng(1)
    handover = make()
    handover.to_torque(Q, 0.5 * TAU + 1.0, True, True)
    periods = 0
    with pytest.raises(HandoverRefused, match=r"torque of b is known to \d+\.\d+% of torque_max"):
        while periods < 10_000:
            noise = np.array([0.0, 5.0, 0.0]) * random.standard_normal(3)
            assert handover.average(Q, 0.5 * TAU + noise) is None
            periods += 1
    assert periods == pytest.approx(PATIENCE / 0.01, abs=1)


def test_a_handover_asked_for_again_begins_to_average_anew():
    handover = taking_over()
    handover.average(Q, -TAU)
    handover.failed("a reason")
    handover.to_torque(Q, -TAU, True, True)
    np.testing.assert_array_equal(handover.average(Q, -TAU), -TAU)
