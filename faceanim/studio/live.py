"""The tab "Live": sliders for expressions, action units, muscles and jaw, what is shown, how it is simulated."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from faceanim.backends import BACKENDS
from faceanim.expression.action_units import Jaw, Side, load_action_units
from faceanim.expression.library import expression_names
from faceanim.ground.errors import FaceanimError
from faceanim.studio.engine import Setup, scheme_names
from faceanim.studio.mixing import Demands, Mixer
from faceanim.studio.simulation import Target

if TYPE_CHECKING:
    from faceanim.studio.page import Studio

UPPER_FACE = (1, 2, 4, 5, 6, 7, 43, 45, 46)
"""Action units of brows, lids and cheeks; those of the jaw alone form a group of their own."""
SHOWN = {"skin": "Skin", "skull": "Skull", "muscles": "Muscles", "sets": "Node sets", "wireframe": "Wireframe"}
SEE_THROUGH = 0.45
"""Opacity that the skin takes when what lies beneath is to be seen."""


class LiveTab:
    """The widgets of the tab; made inside the tab's container."""

    def __init__(self, studio: Studio) -> None:
        self.studio, self.gui = studio, studio.server.gui
        self.demands = Demands()
        self.mixer = Mixer(studio.standard_names)
        self._sliders: list[Any] = []
        self._muscle_folder: Any = None
        self._muscle_groups: list[Any] = []
        self._muscle_sliders: list[Any] = []
        self._quiet = False
        self.status = self.gui.add_markdown("preparing the simulation ...")
        self._recording()
        rest = self.gui.add_button("Rest", hint="All sliders to zero, the face at rest")
        rest.on_click(self._guarded(lambda: self.rest()))
        self._expressions()
        self._units()
        self._jaw()
        self._muscle_folder = self.gui.add_folder("Single muscles", expand_by_default=False)
        self.rebuild_muscles(studio.standard_names)
        self._show()
        self._simulation()

    def _guarded(self, action: Callable[[], Any]) -> Callable[[Any], None]:
        """Return a callback that runs `action` and turns its errors into messages on the page."""

        def callback(_: Any) -> None:
            with self.studio.reporting():
                action()

        return callback

    def _slider(self, label: str, put: Callable[[float], None], low: float = 0.0, hint: str | None = None) -> Any:
        slider = self.gui.add_slider(label, low, 1.0, 0.01, 0.0, hint=hint)

        @slider.on_update
        def _(_: Any) -> None:
            with self.studio.reporting():
                put(float(slider.value))
                self._changed()

        self._sliders.append(slider)
        return slider

    def _expressions(self) -> None:
        with self.gui.add_folder("Expressions"):
            for name in expression_names():
                if name != "neutral":
                    self._slider(name.capitalize(), self._put(self.demands.expressions, name))

    def _units(self) -> None:
        table = load_action_units()
        groups: dict[str, list[int]] = {"Upper face": [], "Lower face": [], "Jaw": []}
        for number, unit in sorted(table.items()):
            group = "Jaw" if not unit.muscles else "Upper face" if number in UPPER_FACE else "Lower face"
            groups[group].append(number)
        with self.gui.add_folder("Action units", expand_by_default=False):
            for group, numbers in groups.items():
                with self.gui.add_folder(group, expand_by_default=False):
                    for number in numbers:
                        self._unit(number, table[number])

    def _unit(self, number: int, unit: Any) -> None:
        sides: tuple[tuple[str, Side], ...] = (("", "both"),)
        if unit.sides == "one":
            sides = (("L", "left"), ("R", "right"))
        for letter, side in sides:
            hint = unit.name if side == "both" else f"{unit.name}, the subject's {side}"
            self._slider(f"{letter}{number} {unit.name}", self._put(self.demands.units, (number, side)), hint=hint)

    def _jaw(self) -> None:
        with self.gui.add_folder("Jaw"):
            for name, (low, _) in Jaw.LIMITS.items():
                hint = "positive to the subject's left" if low < 0.0 else None
                self._slider(name.capitalize(), self._put(self.demands.jaw, name), low, hint)

    def _put(self, values: dict[Any, float], key: Any) -> Callable[[float], None]:
        return lambda value: values.__setitem__(key, value)

    def rebuild_muscles(self, names: tuple[str, ...]) -> None:
        """Offer a slider for each of the muscles `names`, in two folders and one for those without a side."""
        for group in self._muscle_groups:
            group.remove()
        fixed, self._sliders, self._muscle_groups = self._sliders, [], []
        self.demands.muscles = {k: v for k, v in self.demands.muscles.items() if k in names}
        groups = {"Left": "_left", "Right": "_right", "Both sides": ""}
        with self._muscle_folder:
            for group, end in groups.items():
                own = [n for n in names if (n.endswith(end) if end else not n.endswith(("_left", "_right")))]
                if not own:
                    continue
                folder = self.gui.add_folder(group, expand_by_default=False)
                self._muscle_groups.append(folder)
                with folder:
                    for name in sorted(own):
                        label = name.removesuffix(end).replace("_", " ") if end else name.replace("_", " ")
                        self._slider(label, self._put(self.demands.muscles, name), hint=name)
        self._muscle_sliders, self._sliders = self._sliders, fixed

    def _show(self) -> None:
        with self.gui.add_folder("Show"):
            self.boxes: dict[str, Any] = {
                key: self.gui.add_checkbox(label, key == "skin") for key, label in SHOWN.items()
            }
            self.opacity: Any = self.gui.add_slider("Skin opacity", 0.0, 1.0, 0.01, 1.0)
            self.legend = self.gui.add_markdown(_LEGEND, visible=False)
        for key, box in self.boxes.items():
            box.on_update(self._guarded(lambda key=key: self._seen(key)))  # type: ignore[misc]
        self.opacity.on_update(self._guarded(lambda: self.studio.scene.set_opacity(self.opacity.value)))

    def _seen(self, key: str) -> None:
        if self._quiet:
            return
        value = bool(self.boxes[key].value)
        if key in ("skull", "muscles") and value and self.opacity.value > SEE_THROUGH:
            self.opacity.value = SEE_THROUGH
        beneath = self.boxes["skull"].value or self.boxes["muscles"].value
        if key in ("skull", "muscles") and not beneath and self.opacity.value == SEE_THROUGH:
            self.opacity.value = 1.0
        self.studio.scene.see(**{key: value})
        if key == "sets":
            self.legend.visible = value
            self.studio.sets.watch(value)

    def look(self, skull: bool, muscles: bool, opacity: float) -> None:
        """Show or hide skull and muscles and draw the skin with `opacity`, as the widgets then say."""
        with self._silently():
            self.boxes["skull"].value, self.boxes["muscles"].value = skull, muscles
            self.opacity.value = opacity
        self.studio.scene.see(skull=skull, muscles=muscles)
        self.studio.scene.set_opacity(opacity)

    def _simulation(self) -> None:
        setup = self.studio.simulation.setup
        with self.gui.add_folder("Simulation"):
            self.backend: Any = self.gui.add_dropdown("Backend", tuple(BACKENDS), initial_value=setup.backend)
            self.scheme: Any = self.gui.add_dropdown("Scheme", _schemes(setup), initial_value=_scheme(setup))
        self.backend.on_update(self._guarded(self._exchange_backend))
        self.scheme.on_update(self._guarded(self._exchange_scheme))

    def _exchange_backend(self) -> None:
        name = self.backend.value
        if self._quiet or name == self.studio.simulation.setup.backend:
            return
        self.studio.simulation.exchange(lambda old: replace(old, backend=name, options=None))
        self.show_setup()

    def _exchange_scheme(self) -> None:
        scheme = self.scheme.value
        if not self._quiet and scheme != _scheme(self.studio.simulation.setup):
            self.studio.simulation.exchange(lambda old: old.with_scheme(scheme))

    def show_setup(self) -> None:
        """Set the dropdowns to what is simulated."""
        setup = self.studio.simulation.setup
        with self._silently():
            self.backend.value = setup.backend
            self.scheme.options = _schemes(setup)
            self.scheme.value = _scheme(setup)

    def _recording(self) -> None:
        self.record: Any = self.gui.add_button(
            "Record", color="red", hint="Write frames, film and positions; press to stop"
        )
        self.progress: Any = self.gui.add_progress_bar(0.0, visible=False, animated=True)
        self.record.on_click(self._guarded(self.studio.toggle_recording))

    def rest(self, *, aim: bool = True) -> None:
        """Set every slider to zero, and with `aim` send the face to rest."""
        with self._silently():
            for slider in [*self._sliders, *self._muscle_sliders]:
                slider.value = 0.0
            for values in (self.demands.expressions, self.demands.units, self.demands.muscles, self.demands.jaw):
                values.clear()
        if aim:
            self.studio.aim(Target())

    def _changed(self) -> None:
        if not self._quiet:
            self.studio.aim(self.mixer.target(self.demands))

    @contextmanager
    def _silently(self) -> Iterator[None]:
        """Widgets that are set in here do not act."""
        self._quiet = True
        try:
            yield
        finally:
            self._quiet = False


def _schemes(setup: Setup) -> tuple[str, ...]:
    return scheme_names(setup.backend) or ("default",)


def _scheme(setup: Setup) -> str:
    from faceanim.backends import backend_class

    options = backend_class(setup.backend).Options() if setup.options is None else setup.options
    try:
        return str(getattr(options, "scheme", "default"))
    except FaceanimError:
        return "default"


_LEGEND = (
    "<small>Node sets of the adaptive scheme for the present sliders: **red** dynamic, **yellow** quasi-static, "
    "**grey** static.</small>"
)
