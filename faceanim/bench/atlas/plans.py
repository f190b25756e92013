"""All maps of a scene: which contenders stand on which map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial

from faceanim.backends import BACKENDS
from faceanim.bench.atlas import bodies
from faceanim.bench.atlas.bodies import Tune
from faceanim.bench.atlas.cells import Plan
from faceanim.bench.atlas.maps import (
    KINDS,
    SCENES,
    Effort,
    Scene,
    activation_plans,
    mass_plans,
    small_scene,
    time_plans,
)
from faceanim.bench.atlas.nuisances import nuisance_plans
from faceanim.bench.atlas.schemes import SHAPE, TIME, Choices, Contender, contenders
from faceanim.bench.atlas.solids import force_plans, poisson_plans, stretch_plans
from faceanim.bench.atlas.starts import starts_plans
from faceanim.bench.atlas.turns import turn_plans
from faceanim.body.body import Body
from faceanim.ground.errors import UserError, unknown_name

SHEETS_ONLY = ("mass_spring",)
"""Backends without an inside, which bars and blocks are not for."""
TIME_ONLY = ("explicit, undivided",)
"""Schemes that are only for the maps over the time step."""
LATTICES = ("octree_mass_spring",)


def plans(
    scene: str,
    effort: Effort,
    *,
    maps: Sequence[str] | None = None,
    backends: Sequence[str] | None = None,
    whom: Sequence[Contender] | None = None,
) -> list[Plan]:
    """Return what is to be tried of a scene.

    maps, backends : only these (None = all)   whom : contenders instead of those of the registry
    Raises `UserError` for an unknown scene, map or backend, and where nothing is left.
    """
    if scene not in SCENES:
        raise unknown_name("scene", scene, SCENES)
    for kind, names, known in (("map", maps, KINDS), ("backend", backends, BACKENDS)):
        for name in names or ():
            if name not in known:
                raise unknown_name(kind, name, known)
    kinds = [kind for kind in SCENES[scene] if maps is None or kind in maps]
    found = [plan for kind in kinds for plan in _of_kind(kind, scene, effort, backends, whom)]
    if not found:
        raise UserError(
            f"nothing is left to be tried of scene {scene!r}: its maps are {', '.join(SCENES[scene])}; leave --maps or "
            "--backends out, or choose a scene that these backends can model"
        )
    return found


def _of_kind(
    kind: str, scene: str, effort: Effort, backends: Sequence[str] | None, whom: Sequence[Contender] | None
) -> list[Plan]:
    if kind == "force":
        return force_plans(scene, effort) if whom is None and _any(LATTICES, backends) else []
    if kind == "stretch":
        return stretch_plans(scene, effort) if whom is None and backends is None else []
    table = SHAPE if kind in ("turn", "twist", "bend", "poisson") else TIME
    if scene == "face":
        return _face_plans(kind, effort, _fitting(kind, whom or _of_face(table, effort, backends)))
    stage = small_scene(scene, effort)
    chosen = _fitting(kind, whom or _able(scene, stage.make(bodies.PLAIN), table, backends))
    if kind in ("turn", "twist", "bend"):
        slow = ("neo_hookean, quadratic",) if effort.name == "quick" else ()
        return turn_plans(kind, scene, [who for who in chosen if who.scheme not in slow], effort)
    if kind in ("starts", "statics"):
        return starts_plans(kind, scene, lambda: stage.make(bodies.PLAIN), _distinct(kind, chosen), effort)
    if kind == "nuisance":
        return nuisance_plans(scene, chosen, effort)
    if kind == "poisson":
        return poisson_plans(scene, chosen, effort)
    return _GRIDS[kind](stage, chosen, effort)


_GRIDS: dict[str, Callable[[Scene, Sequence[Contender], Effort], list[Plan]]] = {
    "time": time_plans,
    "mass": mass_plans,
    "activation": activation_plans,
}


def _fitting(kind: str, whom: Sequence[Contender]) -> list[Contender]:
    return [who for who in whom if who.scheme not in TIME_ONLY or kind in ("time", "mass")]


def _any(names: Sequence[str], backends: Sequence[str] | None) -> bool:
    return backends is None or any(name in backends for name in names)


def _able(scene: str, body: Body, table: dict[str, Choices], backends: Sequence[str] | None) -> list[Contender]:
    """Return the contenders that model such a body; skin's own backends do not stand for a bar."""
    return [
        who
        for who in contenders(table, backends)
        if (scene == "sheet" or who.backend not in SHEETS_ONLY) and who.takes(body)
    ]


def _distinct(kind: str, whom: Sequence[Contender]) -> list[Contender]:
    """Return one contender per backend where time schemes make no difference: the static search of skin is one."""
    if kind != "statics":
        return list(whom)
    usual = {who.backend: who for who in whom if who.scheme == "conjugate_gradient"}
    return [who for who in whom if usual.get(who.backend, who) is who]


def _of_face(table: dict[str, Choices], effort: Effort, backends: Sequence[str] | None) -> list[Contender]:
    """Return the schemes of skin, and of other backends if they are named or the effort is full."""
    if backends is None and effort.name != "full":
        backends = SHEETS_ONLY
    return contenders(table, backends)


def _face_plans(kind: str, effort: Effort, whom: Sequence[Contender]) -> list[Plan]:
    """Return a map of the coarse face."""
    solid = any(who.backend not in SHEETS_ONLY for who in whom)
    body = lru_cache(maxsize=None)(partial(_coarse_face, solid))
    if kind in ("starts", "statics"):
        return starts_plans(kind, "face", body, _distinct(kind, whom), effort, lips=effort.name == "full")

    def tuned(tune: Tune) -> Body:
        return _stiffened(body(), tune)

    stage = Scene("face", tuned, lambda _: body(), [1], "coarse face")
    return _GRIDS[kind](stage, whom, effort)


def _coarse_face(solid: bool) -> Body:
    """Return the coarse face, without its inside where nobody asks for it."""
    from faceanim.face.library import load_face

    body: Body = load_face(density="coarse").body()
    return body if solid else replace(body, volume=None)


def _stiffened(body: Body, tune: Tune) -> Body:
    """Return skin, tethers, contacts and muscles stiffened alike."""
    k, attachment, muscles = tune.stiffness, body.attachment, body.muscles
    shear = None if attachment.shear is None else attachment.shear * k
    return replace(
        body, membrane_modulus=body.membrane_modulus * k, contact_stiffness=body.contact_stiffness * k,
        attachment=replace(attachment, stiffness=attachment.stiffness * k, shear=shear),
        muscles=replace(muscles, max_force=muscles.max_force * k),
    )  # fmt: skip
