# SPDX-License-Identifier: Apache-2.0
from sim_bridge.scenario import progress as module
from sim_bridge.scenario.progress import Progress


def test_it_prints_a_line_for_each_quarter_and_what_it_waits_for(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    progress = Progress(8.0)
    for _ in range(200):
        now[0] += 0.1
        progress.wait("getting ready: there is no paused robot")
    for k in range(1, 4001):
        progress.show(0.002 * k, f"TRACKING {k}")
    lines = capsys.readouterr().out.splitlines()
    assert lines == [
        "waiting for the nodes",
        "getting ready: there is no paused robot",
        *(f"  {t}.00 of 8 s  TRACKING {500 * t}" for t in (2, 4, 6, 8)),
    ]
