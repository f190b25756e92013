"""Stability maps: every failure is a cell with a reason, broken solvers fail, a run goes on where it stopped."""

from __future__ import annotations

import csv
import io
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faceanim.backends import BACKENDS
from faceanim.backends.mass_spring.options import Options
from faceanim.backends.mass_spring.solver import SolverMassSpring
from faceanim.backends.solver import StepReport
from faceanim.bench.atlas import bodies as atlas_bodies
from faceanim.bench.atlas import cells as atlas
from faceanim.bench.atlas import maps as atlas_maps
from faceanim.bench.atlas.cells import Atlas, Axis, Cell, Map, Plan, Store, as_csv, fill, load, missing, tried
from faceanim.bench.atlas.charts import edges, map_chart, overview, place
from faceanim.bench.atlas.nuisances import NUISANCES, changed, idle
from faceanim.bench.atlas.page import page
from faceanim.bench.atlas.plans import plans
from faceanim.bench.atlas.schemes import TIME, Contender, contender, contenders
from faceanim.bench.atlas.starts import STARTS, recovery, spoil, spoilt
from faceanim.bench.atlas.trials import Goal
from faceanim.body.control import Control
from faceanim.ground.errors import DivergenceError, RunError, UserError

STEP = 1 / 60


def grid(trial: Any, *, seconds: float = 5.0, words: tuple[str, ...] = ("a", "b")) -> Plan:
    """Return a plan of two by two cells."""
    x = Axis("size", "mm", [1.0, 10.0], log=True)
    return Plan(Map("sheet/time/x/y", "time", "sheet", "toy", "x", "y", x, Axis.of_words("kind", words), 0.05, "it"),
                trial, list, seconds)  # fmt: skip


class Broken(SolverMassSpring):
    """A solver of skin whose steps do the wrong thing, its equilibria the right one."""

    fault = ""

    def step(self, state_in: Any, state_out: Any, control: Any, dt: float) -> StepReport:
        away = state_in.q - self.body.surface.points
        if self.fault == "grows":
            state_out.q[:] = self.body.surface.points + 1.5 * away + 1e-3
        elif self.fault == "nan":
            state_out.q[:] = np.nan
        elif self.fault == "turns inside out":
            state_out.q[:] = self.body.surface.points * [-1.0, 1.0, 1.0]
        elif self.fault == "breaks":
            state_out.q[:, 3] = 0.0
        return StepReport()


def broken(fault: str) -> Contender:
    """Return a contender with this fault."""
    made = type("Faulty", (Broken,), {"fault": fault})
    return Contender("broken", fault, lambda body: made(body, Options()))


@pytest.mark.parametrize(
    ("fault", "outcome"),
    [
        ("grows", "not finite"),
        ("nan", "not finite"),
        ("never moves", "bounded but wrong"),
        ("turns inside out", "inverted"),
        ("breaks", "not finite"),
    ],
)
def test_a_broken_solver_shows_up_as_failing(fault: str, outcome: str) -> None:
    """A step that grows, is no number, stands still, turns inside out or raises: no cell of its map converges."""
    who = broken(fault)
    for plan in plans("sheet", atlas_maps.QUICK, maps=["time"], whom=[who]):
        cells = [tried(plan, i, j) for i, j in ((0, 2), (4, 4), (4, 0))]
        assert {cell.outcome for cell in cells} == {outcome}
        assert all(cell.reason for cell in cells)
    recovering, nuisance = (
        plans("sheet", atlas_maps.QUICK, maps=[kind], whom=[who])[0] for kind in ("starts", "nuisance")
    )
    half = recovering.map.x.words.index("half inverted")
    assert tried(recovering, half, 0).outcome not in ("converged", "refused")
    if fault != "never moves":
        assert tried(nuisance, nuisance.map.x.words.index("idle steps"), 0).outcome != "converged"


def test_a_sound_solver_converges_on_the_same_trials() -> None:
    """The default scheme comes to its equilibrium, recovers and does not drift, so the trials above can be passed."""
    who = contender("mass_spring", "conjugate_gradient", {})
    plan = plans("sheet", atlas_maps.QUICK, maps=["time"], whom=[who])[0]
    assert {tried(plan, i, j).outcome for i, j in ((0, 2), (4, 4), (4, 0))} == {"converged"}
    plain = atlas_bodies.skin()
    assert idle(who, plain, atlas_maps.QUICK).outcome == "converged"
    assert recovery(who, plain, "half inverted", atlas_maps.QUICK, static=False).outcome == "converged"
    for name in ("nodes permuted", "elements permuted", "negative winding"):
        mesh = NUISANCES[name].mesh(atlas_bodies.skin_mesh())
        assert changed(who, plain, atlas_bodies.skin(mesh), NUISANCES[name], atlas_maps.QUICK).outcome == "converged"


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (UserError("no volume"), "refused"),
        (RunError("no equilibrium"), "refused"),
        (DivergenceError("ran away"), "not finite"),
        (ZeroDivisionError("oh"), "not finite"),
    ],
)
def test_whatever_goes_wrong_is_an_outcome_with_a_reason(error: Exception, outcome: str) -> None:
    """The program's own complaints are refusals or divergence, any other exception is a broken cell; none gets out."""

    def trial(x: Any, y: Any) -> Cell:
        raise error

    cell = tried(grid(trial), 0, 0)
    assert (cell.outcome, str(error) in cell.reason) == (outcome, True)


def test_a_trial_that_hangs_is_stopped() -> None:
    """After its time it is refused, with the time said."""

    def trial(x: Any, y: Any) -> Cell:
        time.sleep(30.0)
        return Cell("converged")

    started = time.perf_counter()
    cell = tried(grid(trial, seconds=0.2), 0, 0)
    assert cell.outcome == "refused" and "no answer within 0.2 s" in cell.reason
    assert time.perf_counter() - started < 5.0


def test_an_interruption_loses_nothing_and_a_second_run_goes_on(tmp_path: Path) -> None:
    """Cells tried before Ctrl-C are in the file; the next run tries only the others, in other words of the grid too."""
    asked: list[tuple[float, str]] = []

    def trial(x: Any, y: Any) -> Cell:
        asked.append((x, y))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return Cell("converged")

    path = tmp_path / "atlas.json"
    with pytest.raises(KeyboardInterrupt):
        fill(grid(trial), Store(path))
    assert len(load(path.read_bytes(), "it").maps[0].cells) == 2
    done = fill(grid(trial), Store(path))
    assert asked == [(1.0, "a"), (10.0, "a"), (1.0, "b"), (1.0, "b"), (10.0, "b")]
    assert len(done.cells) == 4
    again = Store(path)
    assert not missing(grid(trial), again)
    assert missing(grid(trial, words=("a", "b", "c")), again) == [(0, 2), (1, 2)]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["atlas.json"]


@pytest.mark.parametrize("data", [b"", b"{", b'{"version": 99}', b'{"maps": 3}',
                                  b'{"version": 1, "maps": [{"cells": {"a": {"outcome": "fine"}}}]}'])  # fmt: skip
def test_a_damaged_file_is_refused_and_kept(tmp_path: Path, data: bytes) -> None:
    """The message names the file and the way out; the file stays as it is."""
    path = tmp_path / "atlas.json"
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"atlas\.json.*start anew"):
        Store(path)
    assert path.read_bytes() == data


def test_an_unknown_outcome_is_refused() -> None:
    """A whole file with an outcome that no colour belongs to."""
    one = replace(grid(None).map, cells={"1|a": Cell("fine")})
    import msgspec

    with pytest.raises(UserError, match="fine"):
        load(msgspec.json.encode(Atlas(maps=[one])), "it")


def test_a_new_backend_appears_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything registered is tried, under its schemes or as it comes."""
    assert {who.backend for who in contenders(TIME)} == set(BACKENDS)
    monkeypatch.setitem(BACKENDS, "toy", "toys:ToySolver")
    assert [who.label for who in contenders(TIME) if who.backend == "toy"] == ["toy"]
    assert set(TIME["mass_spring"]) >= {
        "paper",
        "semi_implicit",
        "explicit",
        "block_descent",
        "conjugate_gradient",
        "newton",
    }


@pytest.mark.parametrize(
    ("asked", "part"),
    [
        ({"scene": "shet"}, "did you mean 'sheet'"),
        ({"maps": ["tim"]}, "unknown map 'tim'"),
        ({"backends": ["mass"]}, "unknown backend"),
        ({"maps": ["stretch"]}, "nothing is left"),
        ({"backends": ["mixed_fem"]}, "nothing is left"),
    ],
)
def test_nothing_to_try_is_a_mistake(asked: dict[str, Any], part: str) -> None:
    """Unknown names, maps of another scene, backends that cannot model it."""
    with pytest.raises(UserError, match=part):
        plans(**({"scene": "sheet", "effort": atlas_maps.QUICK} | asked))  # type: ignore[arg-type]


@pytest.mark.parametrize("start", STARTS)
def test_starts_spoil_only_what_is_free(start: str) -> None:
    """Held vertices stay; plane, line and point have no extent left across; inverted means turned over."""
    mesh = atlas_bodies.skin_mesh()
    free = np.flatnonzero(np.abs(mesh.points[:, :2]).max(axis=1) < 19.0)
    out = spoilt(mesh.points, start, free, mesh.triangles)
    held = np.setdiff1d(np.arange(len(out)), free)
    np.testing.assert_array_equal(out[held], mesh.points[held])
    assert np.abs(out - mesh.points).max() > 1e-3
    flat = {"plane": 1, "line": 2, "point": 3}.get(start, 0)
    assert (np.ptp(out[free], axis=0) < 1e-9).sum() == flat
    if "inverted" in start:
        goal = Goal(atlas_bodies.skin(), mesh.points, 1.0, 0.1)
        assert goal.turned_over(out) >= (1 if start.startswith("one") else len(free) // 2)


def test_all_outputs_say_the_same(tmp_path: Path) -> None:
    """Table, page and pictures hold every cell with its reason; the page fetches nothing."""
    reasons = {(1.0, "a"): Cell("converged"), (10.0, "a"): Cell("refused", "too <big>"),
               (1.0, "b"): Cell("inverted", "inside out"), (10.0, "b"): Cell("not finite", "nan")}  # fmt: skip
    plan = replace(grid(lambda x, y: reasons[x, y]), predict=lambda: [atlas.Limit("here", [3.0, 3.0], [0.0, 1.0])])
    one = fill(plan, Store(tmp_path / "atlas.json"))
    rows = list(csv.DictReader(io.StringIO(as_csv([one]))))
    assert [row["outcome"] for row in rows] == ["converged", "refused", "inverted", "not finite"]
    text = page([one], "a machine")
    assert all(word in text for word in ("too &lt;big&gt;", "inside out", "here", "a machine"))
    assert "http" not in text and "src=" not in text
    map_chart(one, tmp_path / "one.png")
    assert overview([one], tmp_path / "all.png")
    assert not overview([], tmp_path / "none.png")
    assert (tmp_path / "one.png").stat().st_size > 5000 and (tmp_path / "all.png").stat().st_size > 5000


def test_a_limit_is_drawn_where_it_belongs() -> None:
    """Cells lie about their values on a logarithmic axis; between uneven values a limit lies in proportion."""
    assert edges(Axis("t", "s", [0.01, 0.1, 1.0], log=True)) == pytest.approx([-2.5, -1.5, -0.5, 0.5])
    assert place(Axis("t", "s", [0.01, 0.1], log=True), 0.1) == pytest.approx(-1.0)
    assert place(Axis("angle", "", [45.0, 90.0, 360.0]), 225.0) == pytest.approx(1.5)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["sheet", "bar", "block"])
def test_every_map_of_a_scene_fills(scene: str, tmp_path: Path) -> None:
    """No cell of a quick run is left out, none breaks but those of the coarsest weighted residual bar."""
    store = Store(tmp_path / "atlas.json")
    for plan in plans(scene, atlas_maps.QUICK):
        one = fill(plan, store)
        assert len(one.cells) == len(one.x.values) * len(one.y.values)
        assert not [
            c for c in one.cells.values() if c.reason.startswith("broke") and one.backend != "weighted_residual"
        ]


def test_a_search_from_a_collapsed_sheet_says_so() -> None:
    """All free vertices in a line, triangles without area: an equilibrium or an error, never numbers that are none."""
    body = atlas_bodies.skin()
    solver = contender("mass_spring", "newton", {}).make(body)
    with np.errstate(all="ignore"), pytest.raises(DivergenceError, match="finite numbers"):
        solver.solve_static(Control.rest(body), guess=spoil(solver, body, "line"))
