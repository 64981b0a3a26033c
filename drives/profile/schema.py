"""JSON schemas of profiles, for editors that complete and check YAML files."""

from typing import Any, Literal

from drives.profile.drive import DriveProfile
from drives.profile.machine import MachineProfile

ProfileKind = Literal["drive", "machine"]
_MODELS: dict[ProfileKind, type[DriveProfile | MachineProfile]] = {
    "drive": DriveProfile,
    "machine": MachineProfile,
}
_QUANTITIES: dict[str, dict[str, Any]] = {
    "travel": {
        "type": "array",
        "items": {"type": "string", "examples": ["-90 deg", "0.2 m"]},
        "minItems": 2,
        "maxItems": 2,
    },
    **{
        key: {"type": "string", "examples": examples}
        for key, examples in {
            "velocity": ["3 rad/s", "0.5 m/s"],
            "acceleration": ["60 rad/s2", "5 m/s2"],
            "torque": ["12 N m", "200 N"],
            "following_error": ["5 deg", "2 mm"],
            "sag": ["0.2 deg", "0.5 mm"],
        }.items()
    },
}
"""Limits are written with their units; the model sees them as numbers."""


def json_schema(kind: ProfileKind) -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of drive or machine profiles as people write them."""
    schema = _MODELS[kind].model_json_schema(by_alias=True, mode="validation")
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = f"fieldtool {kind} profile"
    schema["properties"].pop("path", None)
    limits = schema.get("$defs", {}).get("Limits")
    if limits is not None:
        for key, written in _QUANTITIES.items():
            about = limits["properties"][key].get("description")
            limits["properties"][key] = (
                written if about is None else {**written, "description": about}
            )
    return schema
