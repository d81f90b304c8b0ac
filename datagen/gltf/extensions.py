"""The glTF extensions that are honoured, approximated or ignored; a file that requires another is refused."""

from __future__ import annotations

from collections.abc import Iterable

from tron.errors import TronError

HONOURED = {
    "KHR_draco_mesh_compression": "decoded by DracoPy",
    "KHR_mesh_quantization": "integers become what they stand for",
    "KHR_texture_transform": "offset, scale and rotation",
    "KHR_texture_basisu": "KTX2 decoded by opengl_basisu, which `pip install 'tron-relight[ktx2]'` brings",
    "EXT_texture_webp": "decoded by Pillow",
    "EXT_texture_avif": "decoded by Pillow",
}
APPROXIMATED = {
    "KHR_materials_pbrSpecularGlossiness": "converted to metallic and roughness by Khronos's formula",
    "KHR_materials_unlit": "its colour becomes a rough dielectric's base color, which light shades",
    "KHR_materials_transmission": "opaque",
    "KHR_materials_diffuse_transmission": "opaque",
    "KHR_materials_volume": "opaque",
    "KHR_materials_clearcoat": "left off: the layer under it shows",
    "KHR_materials_sheen": "left off",
    "KHR_materials_iridescence": "left off",
    "KHR_materials_anisotropy": "isotropic",
    "KHR_materials_dispersion": "opaque",
    "KHR_materials_ior": "1.5",
    "KHR_materials_specular": "1",
    "KHR_materials_emissive_strength": "nothing emits",
    "KHR_materials_variants": "the default variant",
}
IGNORED = {
    "KHR_lights_punctual": "scenes have lights of their own",
    "KHR_animation_pointer": "models do not move",
    "KHR_node_visibility": "every node is shown",
    "KHR_xmp_json_ld": "metadata",
}


def require_known(required: Iterable[str]) -> None:
    """Raise TronError for the first of a file's ``extensionsRequired`` that no table above holds."""
    for name in required:
        if name not in HONOURED and name not in APPROXIMATED and name not in IGNORED:
            raise TronError(f"model requires the glTF extension {name}, which is not read", mend=_mend(name))


def _mend(name: str) -> str:
    if name.endswith("meshopt_compression"):
        return "undo it with `gltf-transform dequantize`, or compress with Draco"
    return "export it without"


def extensions_table() -> str:
    """Markdown table of the extensions, for docs/data.md."""
    rows = [
        f"| `{name}` | {kind} | {text} |"
        for kind, table in (("honoured", HONOURED), ("approximated", APPROXIMATED), ("ignored", IGNORED))
        for name, text in table.items()
    ]
    return "\n".join(["| extension | is | how |", "|---|---|---|", *rows])
