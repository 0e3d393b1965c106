# SPDX-License-Identifier: Apache-2.0
"""The pages of docs/reference say what the nodes really have."""

import importlib.util
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.scenario_node import ScenarioNode
from sim_bridge.node.viewer_node import ViewerNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg import parameter_files
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

NODES = {
    "bounds_node": BoundsNode,
    "estimator_node": EstimatorNode,
    "controller_node": ControllerNode,
    "bullet_node": BulletNode,
    "scenario_node": ScenarioNode,
    "viewer_node": ViewerNode,
}
EXTRA = {
    "bounds_node": {},
    "estimator_node": {},
    "controller_node": {
        "ros2_control_topic": "ros2_control_topic",
        "end_effector_frame": "panda_hand panda_link5",
    },
    "bullet_node": {"publish_clock": True, "start_paused": True, "clock": "lockstep"},
    "scenario_node": {
        "scenario": str(config_folder() / "scenarios" / "panda_press_on_table.yaml"),
        "robot_name": "panda",
    },
    "viewer_node": {},
}
OF_ROS = {"/rosout", "/parameter_events"}
ROWS = [(node, row) for node, table in make_reference.TABLES.items() for row in table]


@pytest.mark.parametrize("page", make_reference.PAGES)
def test_page_is_what_the_tables_say(page):
    text = make_reference.PAGES[page]()
    assert (ROOT / page).read_text(encoding="utf-8") == text, "python scripts/make_reference.py"


def test_check_finds_a_stale_page(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(make_reference, "ROOT", tmp_path)
    assert make_reference.main([]) == 0
    assert make_reference.main(["--check"]) == 0
    (tmp_path / "docs" / "reference" / "topics.md").write_text("old")
    assert make_reference.main(["--check"]) == 1
    assert "docs/reference/topics.md is stale" in capsys.readouterr().err


def start(ros, name):
    table = {row.name for row in make_reference.TABLES[name]}
    given = {k: v for k, v in read_config("panda", name).items() if k in table}
    return ros.start(NODES[name], given | EXTRA[name])


def path_of(topic, node):
    return "/" + topic.name.strip("<>/").replace("~", node)


@pytest.mark.parametrize("name", NODES)
def test_a_node_has_the_topics_and_services_of_the_tables_and_no_others(ros, name):
    node = start(ros, name)
    published = defaultdict(set, node.get_publisher_names_and_types_by_node(name, "/"))
    subscribed = dict(node.get_subscriber_names_and_types_by_node(name, "/"))
    # The pages speak of what may be there: the URDF's topic is read at start only, estimated
    # states are a setting, the scenario node publishes what its scenario has, the viewer what its
    # user does.
    sometimes = {"/robot_description"} if name != "bullet_node" else set()
    if name in ("bounds_node", "controller_node"):
        sometimes.add("/estimated_joint_states")
    for found, ends in ((published, "source"), (subscribed, "sink")):
        listed = {
            path_of(topic, name): topic
            for topic in make_reference.TOPICS
            if name in getattr(topic, ends)
        }
        missing = set(listed) - set(found)
        later = ends == "source" and name in ("scenario_node", "viewer_node")
        assert not missing - sometimes or later, missing
        assert set(found) - set(listed) <= OF_ROS
        for topic in set(found) & set(listed):
            (kind,) = found[topic]
            message = listed[topic].message
            assert kind == f"{message.__module__.split('.')[0]}/msg/{message.__name__}"
    offered = {
        service.removeprefix(f"/{name}/")
        for service, (kind,) in node.get_service_names_and_types_by_node(name, "/")
        if not kind.startswith(("rcl_interfaces/", "type_description_interfaces/"))
    }
    assert offered == {s.name for s in make_reference.SERVICES if s.server == name}


@pytest.mark.parametrize("name", ["bounds_node", "controller_node"])
def test_estimated_states_take_the_place_of_those_reported(ros, name):
    table = {row.name for row in make_reference.TABLES[name]}
    given = {k: v for k, v in read_config("panda", name).items() if k in table}
    node = ros.start(NODES[name], given | {"use_estimated_states": True})
    subscribed = dict(node.get_subscriber_names_and_types_by_node(name, "/"))
    assert "/estimated_joint_states" in subscribed
    assert "/joint_states" not in subscribed


@pytest.mark.parametrize(
    "name", ["bounds_node", "estimator_node", "controller_node", "bullet_node"]
)
def test_topics_have_the_quality_of_service_of_the_tables(ros, name):
    node = start(ros, name)
    for topic in make_reference.TOPICS:
        path = path_of(topic, name)
        for ends, infos in (
            ("source", node.get_publishers_info_by_topic(path)),
            ("sink", node.get_subscriptions_info_by_topic(path)),
        ):
            for info in infos:
                if info.node_name != name or name not in getattr(topic, ends):
                    continue
                wanted = topic.qos
                assert info.qos_profile.reliability == wanted.reliability, topic.name
                latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
                assert latched == (wanted.durability == DurabilityPolicy.TRANSIENT_LOCAL)
                assert wanted.reliability in (
                    ReliabilityPolicy.RELIABLE,
                    ReliabilityPolicy.BEST_EFFORT,
                )


@pytest.mark.parametrize("name", NODES)
def test_a_node_has_the_parameters_of_its_table_and_describes_them(ros, name):
    node = start(ros, name)
    own = {
        parameter
        for parameter in node.list_parameters([], 0).names
        if not parameter.startswith(("use_sim_time", "start_type_description", "qos_overrides"))
    }
    assert own == {row.name for row in make_reference.TABLES[name]}
    for row in make_reference.TABLES[name]:
        shown, expected = node.describe_parameter(row.name), describe(row)
        assert shown.description == expected.description
        assert shown.additional_constraints == expected.additional_constraints
        assert shown.read_only == (not row.live)
        assert shown.floating_point_range == expected.floating_point_range
        assert shown.integer_range == expected.integer_range


def test_the_names_of_all_nodes_are_known():
    assert set(make_reference.TABLES) == set(parameter_files.NODES)


@pytest.mark.parametrize(("node", "row"), ROWS, ids=lambda each: getattr(each, "name", each))
def test_each_parameter_says_what_it_is_and_what_is_allowed(node, row):
    assert row.description
    if row.kind in (float, int):
        (shown,) = [*describe(row).floating_point_range, *describe(row).integer_range]
        assert np.isfinite([shown.from_value, shown.to_value]).all()
        assert shown.from_value < shown.to_value
    if row.kind == list[float]:
        assert row.constraints
    if row.default is not REQUIRED:
        assert not isinstance(row.default, float) or row.default in row.within
        assert row.coerce(None) is not None


@pytest.mark.parametrize("robot", sorted(path.stem for path in config_folder().glob("*.yaml")))
def test_parameter_files_have_only_parameters_that_nodes_have(robot):
    known = {name: {row.name for row in table} for name, table in make_reference.TABLES.items()}
    for name in make_reference.TABLES:
        given = read_config(robot, name)
        if name != "scenario_node":  # it needs a file of its own
            read(make_reference.CONFIGURATIONS[name], given)
        # What is for all nodes is for one of them at least.
        assert set(given) <= set().union(*known.values())
