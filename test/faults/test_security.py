# SPDX-License-Identifier: Apache-2.0
"""The policy of DDS security says what the nodes really have, and ROS' tools read it."""

import os
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest
from test_reference import EXTRA, NODES, make_reference

from sim_bridge.nodes import run_listener
from sim_bridge.nodes.bullet_node import BulletNode
from torque_safety_controller.node import safety_stack
from viability_bounds_pkg.ros.topics import USER
from viability_bounds_pkg.testing.executables import run_to_end
from viability_bounds_pkg.testing.ros_harness import read_config

ROOT = Path(__file__).resolve().parents[2]
POLICY = ROOT / "config" / "security" / "policy.xml"
SCRIPT = ROOT / "scripts" / "security.sh"
STACKS = {
    "safety_stack": {kind.NAME for kind in safety_stack.KINDS},
    "simulated_stack": {kind.NAME for kind in (BulletNode, *safety_stack.KINDS)},
}
RIGHTS = ("publish", "subscribe", "reply", "request")
NAMED_BY_A_PARAMETER = "ros2_control_topic"
OWN = {"publish": {"/parameter_events", "/rosout"}, "subscribe": {"/clock"}}
"""What every node has from ROS."""
HAS_TOOLS = (
    shutil.which("ros2") is not None and run_to_end("ros2", "security", "--help").returncode == 0
)


def expressions(path):
    """The elements of a profile, those of the files that it includes, too."""
    for element in ElementTree.parse(path).getroot():
        if element.tag.endswith("}include"):
            yield from expressions(path.parent / element.get("href"))
        else:
            yield element


def granted(node):
    """What the policy grants a node: names by right."""
    found = {right: set() for right in RIGHTS}
    for element in expressions(POLICY.parent / f"{node}.xml"):
        ((right, grant),) = element.attrib.items()
        assert grant == "ALLOW"
        names = [re.sub("^~", f"/{node}", each.text) for each in element]
        names = {name if name.startswith("/") else f"/{name}" for name in names}
        assert not names & found[right]
        found[right] |= names
    return found


def used(ros, name, **changed):
    """What a node publishes, hears, offers and calls."""
    table = {row.name for row in make_reference.TABLES[name]}
    given = {k: v for k, v in read_config("panda", name).items() if k in table}
    node = ros.start(NODES[name], given | EXTRA[name] | changed)
    queries = (
        node.get_publisher_names_and_types_by_node,
        node.get_subscriber_names_and_types_by_node,
        node.get_service_names_and_types_by_node,
        node.get_client_names_and_types_by_node,
    )
    found = {
        right: {topic for topic, _ in query(name, "/")}
        for right, query in zip(RIGHTS, queries, strict=True)
    }
    ros.stop(node)
    return found


@pytest.mark.parametrize("name", NODES)
def test_a_node_may_do_what_it_does_and_nothing_else(ros, name):
    variants = [used(ros, name, use_sim_time=True)]
    if name in ("bounds_node", "controller_node"):
        variants.append(used(ros, name, use_estimated_states=True))
    found = {right: set().union(*(each[right] for each in variants)) for right in RIGHTS}
    found["publish"].discard(f"/{NAMED_BY_A_PARAMETER}")
    # Heard at start only, where a parameter says so.
    if "robot_description" in {t.name for t in make_reference.TOPICS if name in t.sink}:
        found["subscribe"].add("/robot_description")
    # They publish what a scenario has, and what a user does.
    if name in ("scenario_node", "viewer_node"):
        found["publish"] |= {f"/{t.name}" for t in make_reference.TOPICS if name in t.source}
    if name == "scenario_node":  # with --record
        found["subscribe"] |= {f"/{topic}" for topic, _, _ in run_listener._FURTHER}
    assert found == granted(name)
    for right, names in OWN.items():
        assert names <= found[right]


def test_a_user_gives_goals_and_reads():
    rights = granted("user")
    topics = [(topic, topic.name.strip("/")) for topic in make_reference.TOPICS]
    assert rights["publish"] == {f"/{path}" for topic, path in topics if USER in topic.source}
    readings = {
        f"/{path.replace('~', source)}"
        for topic, path in topics
        if USER in topic.sink and "<" not in path
        for source in topic.source
    }
    assert rights["subscribe"] - readings == {
        "/joint_states",
        "/diagnostics",
        "/robot_description",
    }
    assert readings <= rights["subscribe"]
    assert rights["request"] == {f"/{s.server}/{s.name}" for s in make_reference.SERVICES}
    assert not rights["reply"]


def test_each_program_has_an_enclave_with_its_nodes():
    wanted = {name: {name} for name in (*NODES, "moveit_node", "user")} | STACKS
    found = {}
    for enclave in ElementTree.parse(POLICY).getroot().find("enclaves"):
        profiles = enclave.find("profiles")
        found[enclave.get("path").removeprefix("/arm/")] = {each.get("node") for each in profiles}
        for profile in profiles:
            (included,) = profile
            assert included.get("href") == f"{profile.get('node')}.xml"
            assert profile.get("ns") == "/"
    assert found == wanted
    page = (ROOT / "docs" / "security.md").read_text()
    assert {*re.findall(r"`/arm/(\w+)`", page)} == set(wanted)


def run(*words, **environment):
    return run_to_end("bash", SCRIPT, *words, env=os.environ | environment)


@pytest.mark.skipif(not HAS_TOOLS, reason="there is no `ros2 security` here")
def test_the_tools_of_ros_make_permissions_of_it(tmp_path):
    result = run(str(tmp_path / "keys"), ROS_DOMAIN_ID="7")
    assert result.returncode == 0, result.stderr
    assert f"export ROS_SECURITY_KEYSTORE={tmp_path}/keys" in result.stdout
    for name in (*NODES, "moveit_node", "user"):
        folder = tmp_path / "keys" / "enclaves" / "arm" / name
        assert (folder / "permissions.p7s").stat().st_size > 0
        root = ElementTree.parse(folder / "permissions.xml").getroot()
        assert {each.text for each in root.iter("id")} == {"7"}
        assert [each.text for each in root.iter("default")] == ["DENY"]
        rights = granted(name)
        for end, prefixes in (
            ("publish", {"rt": "publish", "rr": "reply", "rq": "request"}),
            ("subscribe", {"rt": "subscribe", "rq": "reply", "rr": "request"}),
        ):
            found = {topic.text for part in root.iter(end) for topic in part.iter("topic")}
            suffix = {"rt": "", "rq": "Request", "rr": "Reply"}
            assert found == {"ros_discovery_info"} | {
                f"{prefix}{each}{suffix[prefix]}"
                for prefix, right in prefixes.items()
                for each in rights[right]
            }
    for name in STACKS:
        assert (tmp_path / "keys" / "enclaves" / "arm" / name / "permissions.p7s").exists()
    assert not (tmp_path / "keys" / "private").stat().st_mode & 0o077


@pytest.mark.skipif(HAS_TOOLS, reason="`ros2 security` is here")
def test_without_the_tools_it_says_so_in_one_line(tmp_path):
    result = run(str(tmp_path / "keys"))
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("error: there is no 'ros2 security': ")
    assert len(result.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_node_that_cannot_be_secured_does_not_start_and_says_why(tmp_path):
    """Without keys, or with a middleware that has no security."""
    program = ROOT / "install" / "viability_bounds_pkg" / "lib" / "viability_bounds_pkg"
    secured = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}
    enclave = tmp_path / "enclaves" / "arm" / "bounds_node"
    command = [program / "bounds_node", "--ros-args", "--params-file"]
    command += [ROOT / "config" / "panda.yaml", "--enclave", "/arm/bounds_node"]
    expected = [f"error: .*SECURITY ERROR: directory '{enclave}' does not exist", "error: .+"]
    for pattern in expected:
        result = run_to_end(
            *command, env=os.environ | secured | {"ROS_SECURITY_KEYSTORE": str(tmp_path)}
        )
        assert result.returncode == 1
        assert re.match(pattern, result.stderr.splitlines()[-1]), result.stderr
        assert "Traceback" not in result.stderr
        enclave.mkdir(parents=True, exist_ok=True)  # without the keys
