# SPDX-License-Identifier: Apache-2.0
"""The pages of docs/reference say what the nodes really have."""

import importlib.util
from pathlib import Path

import pytest
from rclpy.qos import DurabilityPolicy

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.scenario_node import ScenarioNode
from sim_bridge.node.viewer_node import ViewerNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.estimator_node import EstimatorNode
from viability_bounds_pkg.parameter import REQUIRED, read
from viability_bounds_pkg.ros.parameters import describe
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

ROOT = Path(__file__).resolve().parents[2]
_SPEC = importlib.util.spec_from_file_location(
    "make_reference", ROOT / "scripts" / "make_reference.py"
)
make_reference = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(make_reference)

SCENARIO = config_folder() / "scenarios" / "panda_press_on_table.yaml"
NODES = {
    BoundsNode: {},
    EstimatorNode: {},
    ControllerNode: {
        "ros2_control_topic": "ros2_control_topic",
        "end_effector_frame": "panda_hand panda_link5",
    },
    BulletNode: {"publish_clock": True, "start_paused": True, "clock": "lockstep"},
    ScenarioNode: {"scenario": str(SCENARIO), "robot_name": "panda"},
    ViewerNode: {},
}
"""With parameters by which a node has all its topics."""

OF_ROS = {"/rosout", "/parameter_events"}
SOMETIMES = {"/robot_description", "/estimated_joint_states", "/commanded_accelerations"}
"""Topics that parameters switch on."""


@pytest.mark.parametrize("page", make_reference.PAGES)
def test_page_is_what_the_tables_say(page):
    text = make_reference.PAGES[page]()
    assert (ROOT / page).read_text(encoding="utf-8") == text, "python scripts/make_reference.py"


@pytest.fixture(params=NODES, ids=lambda kind: kind.NAME)
def node(ros, request):
    """Each of the nodes, running."""
    table = {row.name for row in make_reference.TABLES[request.param.NAME]}
    given = read_config("panda", request.param.NAME)
    given = {name: value for name, value in given.items() if name in table}
    return ros.start(request.param, given | NODES[request.param])


def test_a_node_has_the_topics_services_and_parameters_of_the_tables(node):
    name = node.get_name()
    for end, found, infos in (
        (
            "source",
            dict(node.get_publisher_names_and_types_by_node(name, "/")),
            node.get_publishers_info_by_topic,
        ),
        (
            "sink",
            dict(node.get_subscriber_names_and_types_by_node(name, "/")),
            node.get_subscriptions_info_by_topic,
        ),
    ):
        listed = {
            "/" + topic.name.strip("<>/").replace("~", name): topic
            for topic in make_reference.TOPICS
            if name in getattr(topic, end)
        }
        # They publish what their scenario has, or their user does.
        if end == "sink" or name not in ("scenario_node", "viewer_node"):
            assert set(listed) - set(found) <= SOMETIMES
        assert set(found) - set(listed) <= OF_ROS
        for topic in set(found) & set(listed):
            message = listed[topic].message
            wanted = listed[topic].offered if end == "source" else listed[topic].qos
            kind = f"{message.__module__.split('.')[0]}/msg/{message.__name__}"
            assert found[topic] == [kind]
            for profile in (i.qos_profile for i in infos(topic) if i.node_name == name):
                assert profile.reliability == wanted.reliability, topic
                latched = DurabilityPolicy.TRANSIENT_LOCAL
                assert (profile.durability == latched) == (wanted.durability == latched), topic
    offered = {
        service.removeprefix(f"/{name}/")
        for service, (kind,) in node.get_service_names_and_types_by_node(name, "/")
        if not kind.startswith(("rcl_interfaces/", "type_description_interfaces/"))
    }
    assert offered == {s.name for s in make_reference.SERVICES if s.server == name}
    of_rclpy = ("use_sim_time", "start_type_description", "qos_overrides")
    own = {each for each in node.list_parameters([], 0).names if not each.startswith(of_rclpy)}
    assert own == {row.name for row in make_reference.TABLES[name]}
    for row in make_reference.TABLES[name]:
        shown, expected = node.describe_parameter(row.name), describe(row)
        assert shown.description == expected.description
        assert shown.additional_constraints == expected.additional_constraints
        assert shown.read_only == (not row.live)
        assert shown.floating_point_range == expected.floating_point_range
        assert shown.integer_range == expected.integer_range


@pytest.mark.parametrize("node", make_reference.TABLES)
def test_each_parameter_says_what_it_is_and_what_is_allowed(node):
    for row in make_reference.TABLES[node]:
        assert row.description, row.name
        if row.kind in (float, int):
            (shown,) = [*describe(row).floating_point_range, *describe(row).integer_range]
            assert -1e300 < shown.from_value < shown.to_value < 1e300, row.name
        if row.kind == list[float]:
            assert row.constraints, row.name
        if row.default is not REQUIRED:
            assert not isinstance(row.default, float) or row.default in row.within, row.name


@pytest.mark.parametrize("robot", sorted(path.stem for path in config_folder().glob("*.yaml")))
def test_parameter_files_have_only_parameters_that_nodes_have(robot):
    if robot == "fr3":
        pytest.importorskip("franky_sim")  # it has the URDF
    tables = make_reference.TABLES.items()
    known = {row.name for _, table in tables for row in table}
    for name, _ in tables:
        given = read_config(robot, name)
        if name not in ("scenario_node", "franka_node", "simulated_fr3"):  # they need more
            read(make_reference.CONFIGURATIONS[name], given)
        assert set(given) <= known
