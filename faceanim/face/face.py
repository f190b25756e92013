"""A head: skin, skull, eyes, mouth parts, texture and muscles, frozen; and how it becomes a `Body`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from faceanim.body.body import Attachment, Body, Bone, Muscles
from faceanim.body.solid import Solid
from faceanim.face import attach
from faceanim.face.attach import LID, LIP, MUCOSA, NECK, SCALP, SKIN
from faceanim.face.geodesic import distance_along
from faceanim.face.library import asset_arrays, asset_folder, asset_text
from faceanim.face.muscles import BONES, AnyMuscle, Lids, Terrain, build_muscles, parse_muscles
from faceanim.face.skull import JawMotion, Skull
from faceanim.face.tissue import Tissue, parse_tissue
from faceanim.geometry.closing import together
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats, Ints, floats, ints
from faceanim.ground.errors import AssetError

EYES = ("left", "right")


@dataclass(frozen=True, eq=False)
class Part:
    """A rigid part to be drawn: eyeball, teeth, gums, tongue; `bone` carries it; `colour` (n, 3) sRGB bytes."""

    name: str
    points: Floats
    triangles: Ints
    colour: np.ndarray
    bone: int

    @property
    def touches(self) -> bool:
        """Whether flesh meets it as it meets bone: teeth and gums."""
        return self.name.startswith(("teeth", "gums")) and len(self.triangles) > 0


@dataclass(frozen=True, eq=False)
class Eyeball:
    """centre (3,) and radius [mm]."""

    centre: Floats
    radius: float


@dataclass(frozen=True, eq=False)
class Face:
    """A head at one density, in the head frame [mm].

    mesh : the simulated skin (n vertices);  region : (n,) codes of `attach`;  mirror : (n,) twin vertices
    depth, depth_cranium, depth_jaw : (n,) [mm] to bone;  landmarks : name -> vertex
    contact_sets : the vertex lists of lips and lids that can touch;  muscle_source : where the muscles come from
    """

    name: str
    density: str
    mesh: TriMesh
    region: Ints
    mirror: Ints
    depth: Floats
    depth_cranium: Floats
    depth_jaw: Floats
    landmarks: dict[str, int]
    contact_sets: dict[str, Ints]
    eyes: dict[str, Eyeball]
    skull: Skull
    jaw: JawMotion
    tissue: Tissue
    muscle_table: dict[str, AnyMuscle]
    muscle_source: str = "built-in"
    parts: tuple[Part, ...] = ()
    uv: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.float32))
    uv_triangles: Ints = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int32))

    @classmethod
    def from_assets(cls, name: str, density: str) -> Face:
        """Return the built-in face; raise `AssetError` naming the file that is missing or broken."""
        file = f"face_{density}.npz"
        data = asset_arrays(file)
        mouth = asset_arrays("mouth.npz")
        eyes = asset_arrays("parts.npz")
        try:
            mesh = TriMesh(data["points"], data["triangles"])
            n = len(mesh.points)
            names = [str(v) for v in data["landmark_names"]]
            index = ints(f"{file}: landmark_index", data["landmark_index"], len(names), below=n)
            return cls(
                name=name,
                density=density,
                mesh=mesh,
                region=data["region"].astype(np.int32),
                mirror=ints(f"{file}: mirror", data["mirror"], n, below=n),
                depth=floats(f"{file}: depth", data["depth"], n),
                depth_cranium=floats(f"{file}: depth_cranium", data["depth_cranium"], n),
                depth_jaw=floats(f"{file}: depth_jaw", data["depth_jaw"], n),
                landmarks=dict(zip(names, (int(i) for i in index), strict=True)),
                contact_sets={k: ints(k, data[k], None, below=n) for k in _CONTACT_SETS},
                eyes={s: Eyeball(floats(s, eyes[f"eye_{s}_centre"], 3), float(eyes[f"eye_{s}_radius"])) for s in EYES},
                skull=Skull.from_arrays(asset_arrays("skull.npz")),
                jaw=JawMotion.from_assets(asset_arrays("skull.npz"), asset_text("jaw.toml")),
                tissue=parse_tissue(asset_text("tissue.toml"), "tissue.toml"),
                muscle_table=parse_muscles(asset_text("muscles.toml"), "muscles.toml"),
                parts=tuple(_parts(eyes) + _parts(mouth)),
                uv=np.ascontiguousarray(data["uv"], dtype=np.float32),
                uv_triangles=ints(f"{file}: uv_triangles", data["uv_triangles"], None, 3, below=len(data["uv"])),
            )
        except KeyError as error:
            raise AssetError(f"asset {asset_folder() / file} lacks the array {error}; reinstall faceanim") from error

    def with_muscles(self, table: dict[str, AnyMuscle], source: str) -> Face:
        """Return this head with other muscles; `source` says where they come from."""
        return replace(self, muscle_table=table, muscle_source=source)

    @cached_property
    def texture(self) -> np.ndarray:
        """The skin's colour picture, (h, w, 3) sRGB bytes, first row at the top."""
        import cv2

        for file in ("albedo.png", "albedo.jpg"):
            path = asset_folder() / file
            if path.is_file():
                picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
                if picture is None:
                    raise AssetError(f"asset {path} is not a readable picture; reinstall faceanim")
                return np.ascontiguousarray(picture[:, :, ::-1])
        raise AssetError(f"asset {asset_folder() / 'albedo.png'} is missing; reinstall faceanim")

    @property
    def cranium(self) -> TriMesh:
        """The cranium with the upper jaw."""
        return self.skull.cranium

    @property
    def jaw_mesh(self) -> TriMesh:
        """The mandible at rest."""
        return self.skull.jaw

    @cached_property
    def mouth_side(self) -> Ints:
        """+1 where the upper lip is nearer along the skin than the lower lip, else -1, (n,)."""
        return attach.mouth_side(self.mesh, self.region, self.contact_sets["lip_upper"], self.contact_sets["lip_lower"])

    @cached_property
    def pinned(self) -> Bools:
        """Vertices carried rigidly by bone: the neck's cut, the back of the head, ears, the depth of the mouth."""
        pinned = (self.region == SCALP) | (self.region == attach.EAR)
        pinned |= self._boundary & (self.region == NECK)
        return pinned | (self._boundary & ((self.region == MUCOSA) | (self.region == LID)))

    @cached_property
    def _boundary(self) -> Bools:
        edges = np.sort(self.mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, count = np.unique(edges, axis=0, return_counts=True)
        out = np.zeros(len(self.mesh.points), dtype=bool)
        out[unique[count == 1].ravel()] = True
        return out

    @cached_property
    def bone_weight(self) -> Floats:
        """Share of each bone (cranium, jaw) in carrying each vertex, (n, 2)."""
        share = attach.jaw_share(
            self.mesh, self.region, self.mouth_side, self.depth_cranium, self.depth_jaw, self.tissue.hypodermis
        )
        share = 0.5 * (share + share[self.mirror])
        return np.ascontiguousarray(np.stack([1.0 - share, share], axis=1))

    @cached_property
    def lids(self) -> dict[str, Lids]:
        """Eyeballs with the margins of their lids."""
        return {s: self._lid(s) for s in EYES}

    def _lid(self, side: str) -> Lids:
        eye = self.eyes[side]
        margins = []
        for lid in ("upper", "lower"):
            node = self.contact_sets[f"lid_{lid}_{side}"]
            front = node[self.region[node] == LID]
            margins.append(_lid_edge(self.mesh.points, front, eye.centre, 1.0 if lid == "upper" else -1.0))
        return Lids(eye.centre, eye.radius, margins[0], margins[1])

    @cached_property
    def terrain(self) -> Terrain:
        """The skin as the muscles see it."""
        muscular = np.isin(self.region, (SKIN, LIP, LID, NECK)) & ~self.pinned
        return Terrain(
            points=self.mesh.points,
            normals=self.mesh.vertex_normals,
            area=np.where(muscular, self.mesh.vertex_areas, 0.0),
            side=self.mouth_side,
            lids=self.lids,
            bones=BONES,
        )

    @cached_property
    def muscles(self) -> Muscles:
        """Every muscle's fibres on this skin."""
        return build_muscles(self.muscle_table, self.terrain)

    @property
    def muscle_names(self) -> tuple[str, ...]:
        """Full names, e.g. "zygomaticus_major_left"."""
        return self.muscles.names

    @cached_property
    def attachment(self) -> Attachment:
        """The hypodermis between skin and bone."""
        h = self.tissue.hypodermis
        openings = np.flatnonzero((self.region == LIP) | (self.region == LID)).astype(np.int32)
        margin = distance_along(self.mesh, openings)
        stiffness = attach.attachment_stiffness(self.mesh, self.region, self.depth, margin, h)
        stiffness = 0.5 * (stiffness + stiffness[self.mirror])
        lids = (self.region[self.mesh.triangles] == LID).any(axis=1)
        shear = np.where(lids, h.shear * h.lid_shear, h.shear)
        limit = np.full(len(lids), h.shear_limit)
        return Attachment(self.bone_weight, stiffness, h.alpha, h.s0, shear, limit)

    @cached_property
    def bone_surfaces(self) -> tuple[TriMesh, TriMesh]:
        """Cranium and jaw with their teeth and gums, closed."""
        cranium, jaw = (
            together([bone, *(TriMesh(p.points, p.triangles) for p in self.parts if p.bone == k and p.touches)])
            for k, bone in enumerate((self.cranium, self.jaw_mesh))
        )
        return cranium, jaw

    def body(self) -> Body:
        """Return this head as a body that any backend can move; its volume is grown when it is first asked for."""
        t, mesh = self.tissue, self.mesh
        contact = t.contact
        modulus = np.full(len(mesh.triangles), t.membrane.young_modulus * t.membrane.thickness)
        corner_region = self.region[mesh.triangles]
        for code, factor in ((LIP, t.membrane.lip), (LID, t.membrane.lid), (MUCOSA, t.membrane.mucosa)):
            modulus = np.where((corner_region == code).any(axis=1), modulus * factor, modulus)
        return Body(
            surface=mesh,
            mass=mesh.vertex_areas * t.inertia.thickness * t.inertia.density,
            membrane_modulus=modulus,
            law=t.law(),
            damping=t.inertia.damping,
            pinned=self.pinned,
            attachment=self.attachment,
            muscles=self.muscles,
            bones=tuple(map(Bone, BONES, (self.skull.cranium_grid, self.skull.jaw_grid), self.bone_surfaces)),
            bone_contact=self._bone_contact(),
            spheres=tuple(
                attach.eyeball_contact(mesh.points, f"eye_{s}", e.centre, e.radius, contact, t.solid.lid_thickness)
                for s, e in self.eyes.items()
            ),
            pairs=tuple(self._pairs()),
            contact_stiffness=contact.stiffness,
            labels={"region": self.region, "mirror": self.mirror},
            volume=self._grown,
        )

    def _grown(self) -> Solid:
        from faceanim.face.tissue_volume import tissue_volume  # its cache loads the compiler

        return tissue_volume(self)

    def _bone_contact(self) -> Any:
        movable = np.isin(self.region, (SKIN, LIP)) & ~self.pinned
        grids = (self.skull.cranium_grid, self.skull.jaw_grid)
        reach = 10.0
        return attach.bone_contact(self.mesh.points, movable, grids, reach, self.tissue.contact.bone_clearance)

    def _lip(self, which: str) -> Ints:
        """The vermilion of a lip without the commissures, where both lips are one skin and cannot cross."""
        node = self.contact_sets[f"lip_{which}"]
        corner = abs(float(self.mesh.points[self.landmarks["cheilion_left"], 0]))
        inner = np.abs(self.mesh.points[node, 0]) < corner - _COMMISSURE
        return node[(self.region[node] == LIP) & inner]

    def _pairs(self) -> list[Any]:
        sets = self.contact_sets
        gap = self.tissue.contact.gap
        out = [attach.pair_contact(self.mesh, "lips", self._lip("upper"), self._lip("lower"), 8.0, gap)]
        for side in EYES:
            upper, lower = sets[f"lid_upper_{side}"], sets[f"lid_lower_{side}"]
            out.append(attach.pair_contact(self.mesh, f"lids_{side}", upper, lower, 14.0, gap))
        return out


_COMMISSURE = 2.5
"""Width of the mouth corner [mm]."""

_CONTACT_SETS = (
    "lip_upper", "lip_lower", "lid_upper_left", "lid_lower_left", "lid_upper_right", "lid_lower_right",
)  # fmt: skip


def _parts(arrays: dict[str, np.ndarray]) -> list[Part]:
    names = sorted(k.removesuffix("_points") for k in arrays if k.endswith("_points"))
    return [
        Part(
            name=name,
            points=floats(name, arrays[f"{name}_points"], None, 3),
            triangles=ints(name, arrays[f"{name}_triangles"], None, 3, below=len(arrays[f"{name}_points"])),
            colour=np.ascontiguousarray(arrays[f"{name}_colour"], dtype=np.uint8),
            bone=int(arrays[f"{name}_bone"]),
        )
        for name in names
    ]


def _lid_edge(points: Floats, lid: Ints, centre: Floats, up: float) -> Ints:
    """Return the lid's vertices nearest to the opening: for each of nine columns in x, the lowest (upper lid)."""
    x = points[lid, 0]
    column = np.clip(((x - x.min()) / (np.ptp(x) + 1e-9) * 9).astype(int), 0, 8)
    front = points[lid, 2] > centre[2]
    edge = []
    for k in range(9):
        inside = lid[(column == k) & front]
        if len(inside):
            edge.append(inside[np.argmin(up * points[inside, 1])])
    return np.array(edge, dtype=np.int32)
