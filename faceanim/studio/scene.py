"""The head in the browser: skin with its colours, eyes and mouth, skull, muscles and node sets, moved as they move."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from viser import ViserServer
from viser.transforms import SO3

from faceanim.backends.solver import StepReport
from faceanim.ground.arrays import Floats, Ints
from faceanim.render.colormap import PARTITION
from faceanim.studio.muscle_shapes import MuscleLines
from faceanim.studio.simulation import Moment
from faceanim.studio.skin_layers import Layer, skin_colour, skin_layers

BONE = (221, 210, 186)
STATIC = (158, 168, 178)
MARK_SIZE = 2.4
"""Diameter of the marks of muscles [mm]."""
SET_LIFT = 0.15
"""Height of the colours of node sets over the skin [mm]."""
DISTANCE, FIELD = 900.0, 0.29
"""Of the camera when the page opens: from the middle of the face [mm], and its vertical angle of view [rad]."""


class HeadScene:
    """A face on a viser server; `show` moves it, the other methods choose what is seen. All may be called anywhere."""

    def __init__(self, server: ViserServer, face: Any) -> None:
        self.server, self.face = server, face
        self._lock = threading.RLock()
        self._moment = Moment(0, face.mesh.points, np.eye(4), StepReport(), 0.0)
        self._opacity = 1.0
        self._sets: np.ndarray | None = None
        self._muscles: MuscleLines | None = None
        self._activation: dict[str, float] = {}
        self._chosen = ""
        self._visible = {"skin": True, "skull": False, "muscles": False, "sets": False, "wireframe": False}
        self._stage()
        self._build_parts()
        self._build_skin()
        self._lines: Any = None
        self._marks: Any = None

    def _stage(self) -> None:
        """Set camera and light: a long lens in front of the face, a soft key from above, all of it local."""
        scene, camera = self.server.scene, self.server.initial_camera
        scene.set_up_direction("+y")
        camera.position, camera.look_at, camera.fov = camera_of(self.face.mesh.points)
        camera.up = (0.0, 1.0, 0.0)
        camera.near, camera.far = 20.0, 10_000.0
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_hemisphere("/light/sky", sky_color=(226, 232, 244), ground_color=(132, 104, 92), intensity=1.45)
        scene.add_light_directional("/light/key", intensity=1.7, color=(255, 246, 236), position=(250.0, 400.0, 700.0))
        scene.add_light_directional("/light/fill", intensity=0.6, color=(226, 236, 255), position=(-500.0, 50.0, 500.0))
        scene.world_axes.visible = False

    def _build_parts(self) -> None:
        """Add what is rigid: bones, eyeballs, teeth, gums and tongue; what the jaw carries hangs on one frame."""
        scene, face = self.server.scene, self.face
        self._jaw = scene.add_frame("/jaw", show_axes=False)
        self._bones = [
            scene.add_mesh_simple(
                node, mesh.points, mesh.triangles, color=BONE, side="double", visible=False, cast_shadow=False
            )
            for node, mesh in (("/cranium", face.cranium), ("/jaw/bone", face.jaw_mesh))
        ]
        for part in face.parts:
            parent = "/jaw" if part.bone == 1 else "/head"
            scene.add_glb(f"{parent}/{part.name}", _coloured(part), cast_shadow=False, receive_shadow=False)

    def _build_skin(self) -> None:
        scene, mesh = self.server.scene, self.face.mesh
        plain: dict[str, Any] = {"side": "double", "cast_shadow": False, "receive_shadow": False}
        self._skin = scene.add_mesh_simple("/skin", mesh.points, mesh.triangles, color=skin_colour(), **plain)
        self._layers: list[tuple[Layer, Any]] = []
        for layer in skin_layers(self.face):
            points = layer.points(mesh.points)
            node = f"/skin/{layer.name}"
            self._layers.append(
                (layer, scene.add_mesh_simple(node, points, layer.triangles, color=layer.colour, **plain))
            )
        self._wire = scene.add_mesh_simple(
            "/wire", mesh.points, mesh.triangles, color=(40, 44, 52), wireframe=True, visible=False, cast_shadow=False
        )
        self._set_nodes = [
            scene.add_mesh_simple(
                f"/sets/{name}", mesh.points, mesh.triangles[:1], color=_bytes(colour), visible=False, **plain
            )
            for name, colour in PARTITION[:2]
        ]

    def show(self, moment: Moment) -> None:
        """Move everything to `moment`; only what is visible and moves is sent."""
        with self._lock, self.server.atomic():
            self._moment = moment
            self._move(moment)
        self.server.flush()

    def _move(self, moment: Moment) -> None:
        skin = moment.points.astype(np.float32)
        seen = self._visible
        if seen["skin"]:
            self._skin.vertices = skin
            if not seen["sets"]:
                for layer, handle in self._layers:
                    if layer.moves:
                        handle.vertices = layer.points(moment.points)
        if seen["wireframe"]:
            self._wire.vertices = skin
        if seen["sets"] and self._sets is not None:
            lifted = (moment.points + SET_LIFT * self.face.mesh.vertex_normals).astype(np.float32)
            for handle in self._set_nodes:
                handle.vertices = lifted
        if seen["muscles"] and self._muscles is not None and self._lines is not None:
            self._lines.points = self._muscles.points(moment.points, moment.jaw_pose)
            self._marks.points = self._muscles.marks(moment.points, moment.jaw_pose)
        pose = moment.jaw_pose
        self._jaw.wxyz = SO3.from_matrix(pose[:3, :3]).wxyz
        self._jaw.position = pose[:3, 3]

    def see(self, **visible: bool) -> None:
        """Show or hide `skin`, `skull`, `muscles`, `sets`, `wireframe`."""
        with self._lock, self.server.atomic():
            self._visible.update(visible)
            seen = self._visible
            self._skin.visible = seen["skin"]
            self._skin.color = STATIC if seen["sets"] else skin_colour()
            for _, handle in self._layers:
                handle.visible = not seen["sets"]
            for bone in self._bones:
                bone.visible = seen["skull"]
            self._wire.visible = seen["wireframe"]
            for handle in self._set_nodes:
                handle.visible = seen["sets"] and seen["skin"] and self._sets is not None
            for handle in (self._lines, self._marks):
                if handle is not None:
                    handle.visible = seen["muscles"]
            self._move(self._moment)

    def set_opacity(self, opacity: float) -> None:
        """Draw the skin with `opacity` [0, 1]."""
        with self._lock, self.server.atomic():
            self._opacity = opacity
            value = None if opacity >= 0.995 else float(opacity)
            for handle in [self._skin, *(h for _, h in self._layers), *self._set_nodes]:
                handle.opacity = value

    def set_node_sets(self, node_set: np.ndarray | None) -> None:
        """Colour the node sets, (n,) of 0 dynamic, 1 quasi-static, 2 static; None while they are not known."""
        with self._lock, self.server.atomic():
            self._sets = node_set
            if node_set is not None:
                triangles = self.face.mesh.triangles
                of_triangle = np.min(node_set[triangles], axis=1)
                for k, handle in enumerate(self._set_nodes):
                    handle.faces = _some(triangles[of_triangle == k]).astype(np.uint32)
        self.see()

    def set_muscles(self, lines: MuscleLines) -> None:
        """Draw other muscles."""
        with self._lock, self.server.atomic():
            self._muscles = lines
            moment = self._moment
            points = lines.points(moment.points, moment.jaw_pose)
            if self._lines is not None:
                self._lines.remove()
                self._marks.remove()
                self._lines = self._marks = None
            if not len(points):
                return
            colours = lines.colours(self._activation, self._chosen)
            seen = self._visible["muscles"]
            self._lines = self.server.scene.add_line_segments(
                "/muscles/lines", points, colours, thickness=1.1, visible=seen
            )
            self._marks = self.server.scene.add_point_cloud(
                "/muscles/marks", lines.marks(moment.points, moment.jaw_pose), lines.mark_colour,
                point_size=MARK_SIZE, point_shape="circle", precision="float32", visible=seen,
            )  # fmt: skip

    def paint_muscles(self, activation: dict[str, float], chosen: str = "") -> None:
        """Colour the muscles by activation, the `chosen` one apart."""
        with self._lock:
            if (activation, chosen) == (self._activation, self._chosen):
                return
            self._activation, self._chosen = dict(activation), chosen
            if self._lines is not None and self._muscles is not None:
                self._lines.colors = self._muscles.colours(activation, chosen)


def camera_of(points: Floats) -> tuple[Floats, Floats, float]:
    """Return where the camera is, where it looks, (3,) [mm], and its vertical angle [rad], for a skin (n, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (low + high)
    return np.array([0.0, middle[1], high[2] + DISTANCE]), np.array([0.0, middle[1], middle[2]]), FIELD


def _coloured(part: Any) -> bytes:
    """Return a rigid part with its vertex colours as a glTF binary, whose colours are linear."""
    import trimesh

    from faceanim.render.shading import linear

    colour = np.round(255.0 * linear(np.asarray(part.colour, dtype=np.float64) / 255.0)).astype(np.uint8)
    mesh = trimesh.Trimesh(part.points, part.triangles, vertex_colors=colour, process=False)

    def unlike_metal(tree: dict[str, Any]) -> None:
        # What has no material of its own is shown as metal, which is black where nothing is mirrored.
        tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.45}}]
        for primitive in (p for one in tree["meshes"] for p in one["primitives"]):
            primitive["material"] = 0

    export: Any = trimesh.exchange.gltf.export_glb
    return bytes(export(trimesh.Scene(mesh), tree_postprocessor=unlike_metal))


def _bytes(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    r, g, b = (round(255.0 * v) for v in colour)
    return r, g, b


def _some(triangles: Ints) -> Ints:
    """Return `triangles`, or one without area where there is none: a mesh needs a triangle."""
    return triangles if len(triangles) else np.zeros((1, 3), dtype=np.int32)
