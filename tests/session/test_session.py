"""Sessions: frames in order, from rest, the same every time, and never a picture of what is not a number."""

from __future__ import annotations

import numpy as np
import pytest
from toys import ToyOptions, toy_face

from faceanim.expression.library import load_expression
from faceanim.expression.timeline import Timeline
from faceanim.ground.errors import DivergenceError, UserError
from faceanim.session.session import Session, adjusted


def _session(name: str = "27", **options: object) -> Session:
    return Session(toy_face(), load_expression(name), backend="toy", **options)  # type: ignore[arg-type]


@pytest.mark.usefixtures("toy_backend")
def test_frames_come_in_order_from_rest() -> None:
    """Frame k shows time k / fps; the first is the face at rest; there are duration * fps of them."""
    session = _session(fps=30.0, duration=1.0)
    frames = list(session)
    assert len(frames) == len(session) == 30
    assert [frame.index for frame in frames] == list(range(30))
    assert frames[7].t == 7 / 30
    assert np.array_equal(frames[0].points, session.face.mesh.points)
    assert not np.array_equal(frames[20].points, frames[0].points)


@pytest.mark.usefixtures("toy_backend")
def test_the_same_session_gives_the_same_bytes() -> None:
    """Iterating twice, or with shared arrays, gives identical positions."""
    session = _session("6+12+26", duration=0.5)
    first = [frame.points.tobytes() for frame in session]
    assert first == [frame.points.tobytes() for frame in session]
    assert first == [frame.points.tobytes() for frame in session.frames(copy=False)]


@pytest.mark.usefixtures("toy_backend")
def test_the_control_follows_the_timeline() -> None:
    """Jaw and muscles are where the timeline is at the frame's own time."""
    line = Timeline(onset=0.2, apex=1.0, offset=0.2)
    frames = list(_session("27", timeline=line, duration=1.0))
    chin = int(np.argmin(frames[0].points[:, 1]))
    for frame in frames:
        assert frame.points[chin, 1] == pytest.approx(frames[0].points[chin, 1] - 40.0 * line.at(frame.t), abs=1e-9)


@pytest.mark.usefixtures("toy_backend")
def test_a_frame_is_cut_into_steps_no_longer_than_allowed() -> None:
    """15 fps with steps of at most 1/30 s takes two; 60 fps takes one."""
    assert (_session(fps=15.0).steps_per_frame, _session(fps=15.0).dt) == (2, 1 / 30)
    assert _session(fps=60.0).steps_per_frame == 1
    assert _session(fps=30.0, largest_step=1 / 1000).steps_per_frame == 34


@pytest.mark.usefixtures("toy_backend")
def test_timings_leave_preparation_out() -> None:
    """The solver is prepared and compiled once, before the clock of the frames starts."""
    session = _session(duration=0.2)
    list(session)
    list(session)
    assert session.solver.prepared == 1  # type: ignore[attr-defined]
    assert len(session.timings.frame) == len(session) - 1
    assert session.timings.steps == len(session) - 1
    assert session.timings.phases["dynamic"] == pytest.approx(1e-5 * session.timings.steps)


@pytest.mark.usefixtures("toy_backend")
def test_divergence_names_frame_time_and_step() -> None:
    """What is not a number is an error that says when and what to change, not a frame."""
    session = _session(options=ToyOptions(blow_up=0.2))
    seen = []
    with pytest.raises(
        DivergenceError, match=r"frame 7 \(t = 0\.233 s, steps of 33\.3 ms.*vertex 3 .*choose another scheme"
    ):
        for frame in session:
            seen.append(frame)
    assert all(np.isfinite(frame.points).all() for frame in seen)


@pytest.mark.usefixtures("toy_backend")
@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"fps": 0.0}, "fps = 0 is outside"),
        ({"fps": float("nan")}, "fps = nan is outside"),
        ({"fps": 1e6}, "outside 1..1000"),
        ({"duration": 0.0}, "duration = 0 s is outside"),
        ({"duration": -1.0}, "duration = -1 s"),
        ({"duration": float("inf")}, "duration = inf s"),
        ({"duration": 500.0, "fps": 500.0}, "250000 frames; at most 20000"),
    ],
)
def test_absurd_requests_are_refused(options: dict[str, float], part: str) -> None:
    """Limits are stated in the message."""
    with pytest.raises(UserError) as caught:
        _session(**options)
    assert part in str(caught.value)


def test_adjustments_sit_on_top() -> None:
    """Units, muscles and jaw of one's own replace those of the expression."""
    e = adjusted(load_expression("happiness"), ["R12=0.5"], {"procerus": 0.3}, {"opening": 0.2})
    assert e.formula == "6+L12+R12=0.5"
    assert (e.muscles, e.jaw) == ({"procerus": 0.3}, {"opening": 0.2})
