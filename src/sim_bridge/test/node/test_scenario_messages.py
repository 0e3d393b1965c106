# SPDX-License-Identifier: Apache-2.0
from sim_bridge.node.scenario_messages import to_robot
from sim_bridge.scenario.scenario import load_scenario


def test_payloads_are_sent_as_the_scenario_has_them(tmp_path):
    path = tmp_path / "scenario.yaml"
    path.write_text(
        """
duration: 3
events:
  - {time: 2, payload: {link: hand, mass: 0}}
  - time: 1.5
    payload: {link: hand, mass: 2, centre: [1, 2, 3], inertia: [5, 0.1, 0.2, 6, 0.3, 7]}
  - {time: 1, push: {link: arm, duration: 0.5, force: [1, 0, 0]}}
"""
    )
    messages = to_robot(load_scenario(path), "base")
    assert [(each.topic, each.delay) for each in messages] == [
        ("external_wrench", 1_000_000_000),
        ("external_wrench", 1_500_000_000),
        ("payload", 1_500_000_000),
        ("payload", 2_000_000_000),
    ]
    loaded, gone = (each.content for each in messages[2:])
    assert loaded.header is messages[2].header
    assert loaded.header.frame_id == gone.header.frame_id == "hand"
    inertia = loaded.inertia
    assert (inertia.m, inertia.com.x, inertia.com.y, inertia.com.z) == (2.0, 1.0, 2.0, 3.0)
    moments = inertia.ixx, inertia.ixy, inertia.ixz, inertia.iyy, inertia.iyz, inertia.izz
    assert moments == (5.0, 0.1, 0.2, 6.0, 0.3, 7.0)
    assert gone.inertia.m == 0.0
