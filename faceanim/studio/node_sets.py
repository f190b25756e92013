"""The node sets of the adaptive scheme for what the sliders ask, found beside the running simulation."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from faceanim.backends import backend_class, make_solver
from faceanim.body.control import Control
from faceanim.ground.errors import FaceanimError, UserError
from faceanim.studio.engine import Setup
from faceanim.studio.simulation import Target

ACTS = 0.02
"""Activation or jaw control from which a muscle counts as acting."""


class NodeSets:
    """Keeps the node sets of a face up to date while they are watched, in a thread of its own.

    jaw_motion : the jaw's motion    on_sets(sets) : (n,) of 0 dynamic, 1 quasi-static, 2 static, or None = not known
    on_message(kind, text) : what goes wrong
    """

    def __init__(
        self,
        jaw_motion: Any,
        on_sets: Callable[[np.ndarray | None], None],
        on_message: Callable[[str, str], None],
    ) -> None:
        self.jaw_motion, self.on_sets, self.on_message = jaw_motion, on_sets, on_message
        self._lock = threading.Condition()
        self._wanted: tuple[Setup, Target] | None = None
        self._now: tuple[Setup | None, Target] = (None, Target())
        self._watched = self._stopping = False
        self._shown: Any = None
        self._solver: tuple[Any, Any] = (None, None)
        self._thread = threading.Thread(target=self._run, name="studio-sets", daemon=True)
        self._thread.start()

    def watch(self, watched: bool) -> None:
        """Begin or end to keep the sets up to date."""
        with self._lock:
            self._watched = watched
        if watched:
            self._ask()

    def follow(self, setup: Setup, target: Target) -> None:
        """Note what is simulated and where it heads; cheap when the same muscles act as before."""
        with self._lock:
            self._now = (setup, target)
        self._ask()

    def stop(self) -> None:
        """End the thread."""
        with self._lock:
            self._stopping = True
            self._lock.notify_all()
        self._thread.join(timeout=10.0)

    def _ask(self) -> None:
        with self._lock:
            setup, target = self._now
            if setup is None or not self._watched:
                return
            acting = frozenset(name for name, value in target.activation.items() if value > ACTS)
            jaw = tuple(abs(v) > ACTS for v in (target.jaw.opening, target.jaw.lateral, target.jaw.protrusion))
            key = (id(setup), acting, jaw)
            if key != self._shown:
                self._shown, self._wanted = key, (setup, target)
                self._lock.notify_all()

    def _run(self) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._stopping or self._wanted is not None)
                if self._stopping:
                    return
                wanted, self._wanted = self._wanted, None
            assert wanted is not None
            try:
                self.on_sets(self.find(*wanted))
            except FaceanimError as error:
                self.on_sets(None)
                self.on_message("error", f"node sets: {error}")

    def find(self, setup: Setup, target: Target) -> np.ndarray:
        """Return the node set of every vertex, (n,); raise `UserError` if the backend has no such sets."""
        options = backend_class(setup.backend).Options() if setup.options is None else setup.options
        if not hasattr(options, "adaptive"):
            raise UserError(f"backend {setup.backend} has no node sets")
        if self._solver[0] is not setup:
            self._solver = (setup, make_solver(setup.backend, setup.body, replace(options, adaptive=True)))
        control = Control.rest(setup.body)
        for k, name in enumerate(setup.body.muscles.names):
            control.activation[k] = target.activation.get(name, 0.0)
        for k, bone in enumerate(setup.body.bones):
            if bone.name == "jaw":
                jaw = target.jaw
                control.bone_pose[k] = self.jaw_motion.pose(jaw.opening, jaw.lateral, jaw.protrusion)
        self._solver[1].prepare(control)
        return np.asarray(2 - self._solver[1].partition.node_set.astype(np.int64))
