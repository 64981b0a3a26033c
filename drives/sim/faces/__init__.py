"""Faces of makers' drives, for the simulated node: by the name of the drive profile."""

from drives.sim.faces.face import Face, Motor
from drives.sim.faces.reference import REFERENCE

__all__ = ["REFERENCE", "Face", "Motor", "face_names", "face_of"]


def face_names() -> tuple[str, ...]:
    """Names that :func:`face_of` knows."""
    from drives.sim.faces.others import NAMES

    return ("reference", "epos4", "epos4-dual-loop", *NAMES)


def face_of(name: str) -> Face:
    """Return the face of this name; files of makers are read when they are first wanted.

    Raises
    ------
    ValueError
        If there is none.
    """
    if name == REFERENCE.name:
        return REFERENCE
    if name.startswith("epos4"):
        from drives.sim.faces.maxon import EPOS4, EPOS4_DUAL_LOOP

        for face in (EPOS4, EPOS4_DUAL_LOOP):
            if face.name == name:
                return face
    from drives.sim.faces.others import other_face

    try:
        return other_face(name)
    except KeyError:
        raise ValueError(
            f"no simulated drive looks like {name!r}; there are {', '.join(face_names())}. Give "
            "one of these as `face` in the machine profile's simulation, or `{profile: FILE, eds: FILE}`"
        ) from None
