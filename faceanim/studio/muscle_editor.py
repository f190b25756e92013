"""The tab "Muscles": place muscles by clicks, name, mirror, move and delete them, see their image, load and save."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.face.muscle_places import Places
from faceanim.face.muscles import AnyMuscle, build_muscles
from faceanim.ground.errors import FaceanimError, UserError
from faceanim.ground.files import write_whole
from faceanim.studio.document import MuscleDocument
from faceanim.studio.drawing import DRAWING
from faceanim.studio.muscle_files import png_bytes, read_upload
from faceanim.studio.muscle_shapes import MuscleLines
from faceanim.studio.placing import BONE, LOOK, MODES, Placer

if TYPE_CHECKING:
    from faceanim.studio.page import Studio

KINDS = ("front", "cylinder")
IMAGE_SIZE = 512
"""Side of the muscle image [pixel]."""
SEE_BONE, SEE_MUSCLES = 0.22, 0.7
"""Opacity of the skin while bone is to be clicked, and while something is placed on the skin."""
NONE = "(none)"
_MOST_FAULTS = 12
_ACTIVE = "teal"


class MuscleTab:
    """The widgets of the tab; made inside the tab's container. Changes go to `document` first, then everywhere."""

    def __init__(self, studio: Studio, document: MuscleDocument, prepare_drawing: Callable[[], Any]) -> None:
        self.studio, self.document, self.gui = studio, document, studio.server.gui
        self.places = Places(studio.face)
        self.placer = Placer(self.places)
        self._prepare_drawing = prepare_drawing
        self._lock = threading.RLock()
        self._quiet = False
        self._pull = 0.0
        self._look_before: tuple[bool, bool, float] | None = None
        self._marks: Any = None
        self._changed = threading.Event()
        self._closing = False
        self._names: tuple[str, ...] = ()
        self._simulated: Mapping[str, AnyMuscle] = document.table
        self._tools()
        self._list()
        self._picture()
        self._files()
        self._worker = threading.Thread(target=self._follow, name="studio-muscles", daemon=True)
        self._refresh()
        self._worker.start()

    def close(self) -> None:
        """End the thread that follows the changes."""
        self._closing = True
        self._changed.set()
        self._worker.join(timeout=10.0)

    # Widgets

    def _button(self, label: str, action: Callable[[], Any], **options: Any) -> Any:
        button = self.gui.add_button(label, **options)
        button.on_click(self._guarded(action))
        return button

    def _guarded(self, action: Callable[[], Any]) -> Callable[[Any], None]:
        def callback(_: Any) -> None:
            if not self._quiet:
                with self.studio.reporting(), self._lock:
                    action()

        return callback

    def _tools(self) -> None:
        self.hint = self.gui.add_markdown(self.placer.hint)
        with self.gui.add_folder("Place"):
            self._modes = {
                mode: self._button(label, lambda mode=mode: self.choose(mode), color="gray")  # type: ignore[misc]
                for mode, label in MODES.items()
            }
            self.moving: Any = self.gui.add_checkbox(
                "Move chosen", False, hint="Clicks move the ends of the chosen muscle instead of placing another"
            )
            edit: Any = self.gui.add_button_group("Edit", ("Undo", "Redo"))
            edit.on_click(self._guarded(lambda: {"Undo": self.undo, "Redo": self.redo}[edit.value]()))
            self.history = self.gui.add_markdown("")

    def _list(self) -> None:
        with self.gui.add_folder("Muscle"):
            self.chosen: Any = self.gui.add_dropdown("Muscle", (NONE,), initial_value=NONE)
            self.name: Any = self.gui.add_text("Name", initial_value="", hint="Press enter to rename")
            self.pull: Any = self.gui.add_slider("Pull", 0.0, 1.0, 0.01, 0.0)
            change: Any = self.gui.add_button_group("Change", ("Mirror", "Delete"))
        self.chosen.on_update(self._guarded(self._choose))
        self.name.on_update(self._guarded(self._rename))
        self.pull.on_update(self._guarded(self._pulled))
        change.on_click(self._guarded(lambda: {"Mirror": self.mirror, "Delete": self.delete}[change.value]()))

    def _files(self) -> None:
        with self.gui.add_folder("Files"):
            load: Any = self.gui.add_upload_button(
                "Load PNG or TOML", mime_type=".png,.jpg,.jpeg,.bmp,.toml", color="gray"
            )
            load.on_upload(self._guarded(lambda: self.load(load.value.name, load.value.content)))
            self._button("Save TOML", lambda: self.save("toml"), color="gray")
            self._button("Save PNG", lambda: self.save("png"), color="gray")
            self._button(
                "Built-in muscles", self.built_in, color="gray", hint="Take the built-in muscles; can be undone"
            )

    def _picture(self) -> None:
        with self.gui.add_folder("Muscle image"):
            self.kind: Any = self.gui.add_dropdown("View", KINDS, initial_value=KINDS[0])
            blank = np.full((IMAGE_SIZE, IMAGE_SIZE, 3), 36, np.uint8)
            self.image: Any = self.gui.add_image(blank, format="png")
            self.faults = self.gui.add_markdown("")
        self.kind.on_update(self._guarded(self._changed.set))

    # Placing

    def choose(self, mode: str) -> None:
        """Place something else with clicks, or nothing if `mode` is the one that is on."""
        self.placer.choose(LOOK if self.placer.mode == mode else mode)
        if self.placer.mode != LOOK:
            self.studio.live.rest()
        self._show_mode()

    def _show_mode(self) -> None:
        """Show on the page what the next click places: hint, button, pending marks, and the bone if it is bone."""
        mode, scene = self.placer.mode, self.studio.server.scene
        self.hint.content = self.placer.hint
        for key, button in self._modes.items():
            button.color = _ACTIVE if key == mode else "gray"
        scene.remove_click_callback("all")
        if mode != LOOK:
            scene.on_click()(self._clicked)
        self._look_for(mode)
        points, colours = self.placer.marks()
        if self._marks is not None:
            self._marks.remove()
            self._marks = None
        if len(points):
            self._marks = scene.add_point_cloud(
                "/pending", points, colours, point_size=4.0, point_shape="circle", precision="float32"
            )

    def _look_for(self, mode: str) -> None:
        """Thin the skin so that muscles show through it, and bone when that is to be clicked; afterwards as before."""
        live = self.studio.live
        if mode == LOOK:
            if self._look_before is not None:
                live.look(*self._look_before)
            self._look_before = None
            return
        if self._look_before is None:
            self._look_before = (live.boxes["skull"].value, live.boxes["muscles"].value, live.opacity.value)
        bare = mode == BONE
        live.look(bare or self._look_before[0], True, SEE_BONE if bare else SEE_MUSCLES)

    def _clicked(self, event: Any) -> None:
        with self.studio.reporting(), self._lock:
            try:
                self.click(np.array(event.ray_origin), np.array(event.ray_direction))
            finally:
                self._show_mode()

    def click(self, start: np.ndarray, direction: np.ndarray) -> None:
        """Take a click on the scene, given by its ray (3,), (3,)."""
        name = self.chosen.value
        if self.moving.value and name != NONE:
            self.document.move(name, **self.placer.move(start, direction, self.document.muscle(name)))  # type: ignore[arg-type]
            self._refresh(name)
            return
        rows = self.placer.click(start, direction, self.document.table)
        if rows:
            self.document.place(rows)
            self._refresh(next(iter(rows)))

    # Changes

    def undo(self) -> None:
        """Take back a click that is no muscle yet, else the last change."""
        if self.placer.pending:
            self.placer.drop()
            self._show_mode()
        else:
            self.document.undo()
            self._refresh()

    def redo(self) -> None:
        """Do again what was undone last."""
        self.document.redo()
        self._refresh()

    def mirror(self) -> None:
        """Give the chosen muscle a twin on the other side."""
        self._refresh(self.document.mirror(self._chosen_name()))

    def delete(self) -> None:
        """Take the chosen muscle away."""
        self.document.delete(self._chosen_name())
        self._refresh()

    def _rename(self) -> None:
        if self.chosen.value != NONE and self.name.value != self.chosen.value:
            try:
                self._refresh(self.document.rename(self.chosen.value, self.name.value))
            except FaceanimError:
                self._refresh(self.chosen.value)
                raise

    def _chosen_name(self) -> str:
        if self.chosen.value == NONE:
            raise UserError("no muscle is chosen; choose one from the list")
        return str(self.chosen.value)

    def _choose(self) -> None:
        self._refresh(self.chosen.value, changed=False)
        live = self.studio.live
        if self.chosen.value != NONE and not live.boxes["muscles"].value:
            live.look(live.boxes["skull"].value, True, min(live.opacity.value, SEE_MUSCLES))

    def _pulled(self) -> None:
        name = self.chosen.value
        self.studio.pull({} if name == NONE else {name: float(self.pull.value)}, "" if name == NONE else name)

    def load(self, name: str, content: bytes) -> None:
        """Take the muscles of an uploaded file in place of all there are."""
        table, faults = read_upload(name, content, self.studio.face, self.places)
        self.document.replace_all(table, "load a file")
        self._refresh()
        self.studio.notify("done", "Loaded", f"{len(table)} muscles")
        for fault in faults[:3]:
            self.studio.notify("warning", "In the picture", fault)

    def built_in(self) -> None:
        """Take the built-in muscles in place of all there are."""
        self.document.replace_all(self.places.known, "take the built-in muscles")
        self._refresh()

    def save(self, kind: str) -> None:
        """Write muscles.toml or muscles.png into the work folder and offer it to the browser."""
        name = f"muscles.{kind}"
        data = self.document.text.encode() if kind == "toml" else png_bytes(self._draw())
        write_whole(self.document.folder / name, data)
        self.studio.server.send_file_download(name, data)
        self.studio.notify("done", "Saved", str(self.document.folder / name))

    # After a change

    def _refresh(self, choose: str | None = None, *, changed: bool = True) -> None:
        """Show the document: list, name, lines in the head; image, warnings and simulation follow."""
        table = self.document.table
        names = tuple(sorted(table))
        choose = self.chosen.value if choose is None else choose
        choose = choose if choose in table else NONE
        self._quiet = True
        try:
            self.chosen.options = (NONE, *names)
            self.chosen.value = choose
            self.name.value = "" if choose == NONE else choose
            if not changed or choose == NONE:
                self.pull.value = 0.0
        finally:
            self._quiet = False
        self._pulled()
        undo, redo = self.document.undoable, self.document.redoable
        self.history.content = f"<small>Undo: {undo or 'nothing'} · Redo: {redo or 'nothing'}</small>"
        if changed:
            self.studio.scene.set_muscles(MuscleLines(self.studio.face, table))
            if names != self._names:
                self._names = names
                self.studio.live.rebuild_muscles(names)
            self._changed.set()

    def _follow(self) -> None:
        """Bring simulation, warnings and image up to date with the document, after every change."""
        while True:
            self._changed.wait()
            self._changed.clear()
            if self._closing:
                return
            table = self.document.table
            with self.studio.reporting():
                self._simulate(table)
            with self.studio.reporting():
                self.faults.content = self._faults_of(table)
            with self.studio.reporting():
                self.image.image = self._draw()

    def _simulate(self, table: Mapping[str, AnyMuscle]) -> None:
        if table == self._simulated:
            return
        if not table:
            raise UserError("there are no muscles left; the face keeps the former ones until you place some")
        muscles = build_muscles(table, self.studio.face.terrain)
        self.studio.simulation.use_muscles(muscles)
        self._simulated = table

    def _faults_of(self, table: Mapping[str, AnyMuscle]) -> str:
        from faceanim.face.muscle_check import check_table

        faults = check_table(table, self.studio.face, places=self.places)
        if not faults:
            return "No warnings."
        sign = {"error": "⛔", "warning": "⚠️"}
        lines = [f"- {sign[fault.severity]} {fault.message}" for fault in faults[:_MOST_FAULTS]]
        more = len(faults) - _MOST_FAULTS
        return "\n".join([*lines, *([f"- and {more} more"] if more > 0 else [])])

    def _draw(self) -> np.ndarray:
        from faceanim.render.muscle_picture import muscle_image

        self._prepare_drawing()
        with DRAWING:
            return np.array(
                muscle_image(self.studio.face, self.document.table, self.kind.value, IMAGE_SIZE, places=self.places)[0]
            )
