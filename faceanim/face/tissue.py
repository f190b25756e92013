"""The constants of a head's soft tissue, read from `assets/tissue.toml`, where each has its unit and source."""

from __future__ import annotations

import msgspec

from faceanim.ground.errors import AssetError
from faceanim.tissue.material import Material
from faceanim.tissue.spring_law import SpringLaw


class Membrane(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Skin as a sheet: young_modulus [kPa], thickness [mm], factors [-] on the modulus of lips, lids and mucosa."""

    young_modulus: float
    thickness: float
    lip: float
    lid: float
    mucosa: float


class Springs(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The spring law: see `SpringLaw`."""

    alpha: float
    s0: float
    beta: float
    zeta: float
    height_ratio: float


class Hypodermis(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The tie from skin to bone.

    modulus [kPa], smallest_thickness [mm], alpha [-], s0 [mm] of its growth; factors lip, lid, mucosa [-];
    shear [mN/mm] of the layer (shear modulus times effective depth), shear_limit [-] the gradient at which it has
    doubled, lid_shear [-] the factor on the lids, which do not stiffen;
    fade_length [mm] from the openings; clear_choice, blend_length [mm] of the share between cranium and jaw
    """

    modulus: float
    smallest_thickness: float
    alpha: float
    s0: float
    lip: float
    lid: float
    mucosa: float
    shear: float
    shear_limit: float
    lid_shear: float
    fade_length: float
    clear_choice: float
    blend_length: float


class Inertia(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """density [kg/mm^3], thickness [mm] of the tissue that moves with the skin, damping [1/s]."""

    density: float
    thickness: float
    damping: float


class Contact(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """stiffness [mN/mm per mm^2]; eye_hardness [-] its factor on the eyeball; clearances [mm] to bone and eyeball;
    gap [mm] between lips and lids."""

    stiffness: float
    eye_hardness: float
    bone_clearance: float
    eye_clearance: float
    gap: float


class Layer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One kind of flesh: young_modulus [kPa], poisson_ratio [-]."""

    young_modulus: float
    poisson_ratio: float


class Flesh(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Soft tissue as a volume: density [kg/mm^3], damping [1/s] and stiffness_damping [s] of Rayleigh; lid_thickness
    [mm] by which the outside of a lid is kept off the eyeball; four layers: skin, fat, muscle, and the moist gap between
    lips or cheeks and teeth or gums."""

    density: float
    damping: float
    stiffness_damping: float
    lid_thickness: float
    skin: Layer
    fat: Layer
    muscle: Layer
    gap: Layer


class Tissue(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All soft-tissue constants of a head."""

    membrane: Membrane
    springs: Springs
    hypodermis: Hypodermis
    inertia: Inertia
    contact: Contact
    solid: Flesh

    def materials(self) -> tuple[Material, ...]:
        """Return the materials of the volume, in the order of `tissue_volume`; raise `UserError` for impossible values."""
        flesh = self.solid
        layers = {"skin": flesh.skin, "fat": flesh.fat, "muscle": flesh.muscle, "gap": flesh.gap}
        return tuple(Material(k, flesh.density, row.young_modulus, row.poisson_ratio) for k, row in layers.items())

    def law(self) -> SpringLaw:
        """Return the spring law of the skin."""
        s = self.springs
        return SpringLaw(alpha=s.alpha, s0=s.s0, beta=s.beta, zeta=s.zeta, height_ratio=s.height_ratio)


def parse_tissue(text: str, source: str) -> Tissue:
    """Return the constants of a TOML text; raise `AssetError` naming what does not fit."""
    try:
        return msgspec.toml.decode(text, type=Tissue)
    except msgspec.DecodeError as error:
        raise AssetError(f"{source}: {error}") from error
