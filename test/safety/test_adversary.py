# SPDX-License-Identifier: Apache-2.0
"""The search for goals and pushes that do worst, and what it has found."""

import numpy as np
import pieces
import pytest
from search_adversary import ELITE, ROWS, SMALL, Arena, search

FOUND = [
    # Where the episode starts, then five goals, each with its share of the time.
    # fmt: off
    0.12,
    0.17,
    0.54,
    0.00,
    0.62,
    1.00,
    0.60,
    0.42,
    0.40,
    0.29,
    0.06,
    0.60,
    0.71,
    0.68,
    0.62,
    0.52,
    0.89,
    0.66,
    0.24,
    0.61,
    0.32,
    0.17,
    0.51,
    0.80,
    0.65,
    0.56,
    0.32,
    0.81,
    0.29,
    0.34,
    0.06,
    0.47,
    0.36,
    0.37,
    0.10,
    0.98,
    0.13,
    0.85,
    0.20,
    0.07,
    0.51,
    0.49,
    0.45,
    0.23,
    0.63,
    0.70,
    0.34,
    # fmt: on
]
"""Baxter's speed limit was passed by 20%: plans that end within a step were made for ever."""


@pytest.mark.long
def test_the_worst_episode_that_was_found_keeps_all_limits():
    found = Arena(ROWS["Baxter: goals"]).play(np.array(FOUND))
    assert found["position"] >= 0.0
    assert found["speed"] >= 0.0
    assert found["torque"] >= -1e-9
    assert found["outside"] == 0


@pytest.mark.long
def test_an_episode_can_be_played_again():
    arena, other = Arena(ROWS["Baxter: goals"]), Arena(ROWS["Baxter: goals"])
    genes = np.random.default_rng(0).random(arena.genes)
    first = arena.play(genes)
    arena.play(1.0 - genes)
    assert arena.play(genes) == first == other.play(genes)


@pytest.mark.long
def test_without_the_filter_a_short_search_passes_limits():
    least = search(Arena(ROWS["Baxter: goals, without"]), 15, 0)
    assert least["episodes"] == 15
    assert least["speed"] < -0.05
    assert least["torque"] >= -1e-9, "the limiter keeps torques"


@pytest.mark.long
def test_the_search_comes_nearer_to_what_it_looks_for(monkeypatch):
    """On a landscape that is known: the distance from a point."""
    arena = Arena(ROWS["Baxter: goals"])
    aim = np.random.default_rng(1).random(arena.genes)
    tried = []

    def play(genes):
        tried.append(float(np.linalg.norm(genes - aim)))
        return {"slack": tried[-1]}

    monkeypatch.setattr(arena, "play", play)
    least = search(arena, 600, 0)
    assert least["slack"] == min(tried)
    assert min(tried) < 0.5 * np.median(tried[: 3 * ELITE])
    assert np.linalg.norm(np.array(least["slack, by"]) - aim) == min(tried)


def test_small_pushes_take_their_share_of_the_torque_limits():
    arena = Arena(ROWS["Baxter: goals and small pushes"])
    arena.start(np.full(arena.n, 0.5))
    arena.step()
    arena.push(np.array([0.0, 0.0, -1e3]))
    robot, loop = arena.loop.controller.robot, arena.loop
    force = loop.robot._wrenches[robot.frame].force
    torque = np.abs(robot.J[:3].T @ (robot.pose.rotation.T @ force)) / loop.config.torque_max
    assert torque.max() == pytest.approx(SMALL)


def test_the_greedy_adversary_asks_for_the_corner_after_which_least_is_left():
    arena = Arena(ROWS["Baxter: greedy"])
    arena.start(np.full(arena.n, 0.5))
    loop, n = arena.loop, arena.n
    q, v, _ = loop.robot.state()
    lower, upper, _ = loop.bounds(q, v)
    scout, dt, free = arena._scout, loop.dt, np.full(arena.n, np.inf)

    def left(a):
        scout.reset()
        scout.look(q + dt * v + 0.5 * dt * dt * a, v + dt * a, np.zeros(n), -free, free)
        return scout.slack

    arena.worst_corner(np.ones(n))
    asked = loop.controller.goals.a
    assert np.all((asked == lower) | (asked == upper))
    rng = np.random.default_rng(0)
    others = [left(np.where(rng.random(n) < 0.5, lower, upper)) for _ in range(40)]
    assert left(asked) <= np.quantile(others, 0.2)


@pytest.mark.long
def test_pieces_that_are_done_are_not_done_again(tmp_path, monkeypatch):
    monkeypatch.setattr(pieces, "RESULTS", tmp_path)
    work = [([["a", k]],) for k in range(3)]  # for dict, which every process has

    def do():
        return [result for _, result in pieces.in_pieces("t", dict, work)]

    assert do() == [{"a": 0}, {"a": 1}, {"a": 2}]
    first, second, _ = sorted((tmp_path / "t" / "pieces").iterdir())
    for path in (first, second):
        path.write_text(path.read_text().replace('"result": {"a"', '"result": {"kept"'))
    # Of another state of the sources.
    second.write_text(second.read_text().replace(pieces.sources(), "other"))
    assert sum("kept" in result for result in do()) == 1
