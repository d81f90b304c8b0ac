"""The process in which usd-core reads splats: parsers of USD crash on some damaged files.

    python -I usd_process.py SITE FILE BYTES > arrays.npz

SITE is the folder that usd-core and NumPy are installed in, BYTES is the most memory that the process may ask
for. What went wrong is the last line on stderr.
"""

# usd-core has no types.
# pyright: reportAttributeAccessIssue=false
import io
import os
import sys
from pathlib import Path

PRIM = "ParticleField3DGaussianSplat"
ATTRIBUTES = {
    "positions": "positions",
    "orientations": "orientations",
    "scales": "scales",
    "opacities": "opacities",
    "coefficients": "radiance:sphericalHarmonicsCoefficients",
}
MOST_LAYERS = 1000


def main(site: str, name: str, memory: str) -> None:
    """Write the splats of a stage to stdout."""
    sys.path.insert(0, site)
    output = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    os.environ["PXR_WORK_THREAD_LIMIT"] = "1"  # each asks for memory of its own
    try:
        import resource
    except ImportError:  # Windows has no such limit
        pass
    else:
        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    import numpy as np
    from pxr import Tf, Usd, UsdGeom

    try:
        require_confined(Path(name))
        stage = Usd.Stage.Open(name)
    except Tf.ErrorException as error:
        sys.exit(f"it is damaged: {' '.join(str(error).split())[:200]}")
    held = {"z_up": np.array(UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z)}
    transforms, count = UsdGeom.XformCache(), 0
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.GetTypeName() != PRIM:
            continue
        for key, attribute in ATTRIBUTES.items():
            values = prim.GetAttribute(attribute).Get()
            if not values:  # stored in half precision
                values = prim.GetAttribute(attribute + "h").Get()
            if not values:
                sys.exit(f"{prim.GetPath()} lacks {attribute}")
            held[f"{count}.{key}"] = np.array(values, np.float32)
        held[f"{count}.matrix"] = np.array(transforms.GetLocalToWorldTransform(prim)).T
        count += 1
    if not count:
        meshes = any(prim.IsA(UsdGeom.Mesh) for prim in stage.Traverse(Usd.TraverseInstanceProxies()))
        beside = ", but a mesh: as .glb it is put beside a scene (meshes=)" if meshes else ""
        sys.exit(f"this USD holds no splats ({PRIM}){beside}")
    content = io.BytesIO()
    np.savez(content, **(held | {"count": np.array(count)}))  # pyright: ignore[reportArgumentType]
    with open(output, "wb") as stream:
        stream.write(content.getvalue())


def require_confined(path: Path) -> None:
    """Exit unless all files that a file and its layers refer to lie in a package, in its folder or below."""
    from pxr import Sdf, UsdUtils

    packed = path.suffix.lower() == ".usdz"
    if packed:
        _require_stored(path)
    pending, seen = [str(path)], set()
    while pending and len(seen) < MOST_LAYERS:
        name = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        if Sdf.FileFormat.FindByExtension(Path(name.rstrip("]")).suffix.lstrip(".")) is None:
            continue  # a picture
        layer = Sdf.Layer.FindOrOpen(name)
        if layer is None:
            continue
        for kind in UsdUtils.ExtractExternalReferences(name):
            for inner in kind:
                whole = layer.ComputeAbsolutePath(inner)
                if packed:
                    fine = whole.startswith(f"{path}[")
                    place = whole.removeprefix(f"{path}[").rstrip("]")
                    fine = fine and ".." not in Path(place).parts and not Path(place).is_absolute()
                else:
                    fine = Path(os.path.realpath(whole)).is_relative_to(os.path.realpath(path.parent))
                if not fine:
                    sys.exit(f"it refers to '{' '.join(inner[:80].split())}', outside of it")
                pending.append(whole)


def _require_stored(path: Path) -> None:
    """Exit unless a package's files lie in it as they are (OpenUSD, "Usdz File Format Specification")."""
    import zipfile

    with zipfile.ZipFile(path) as package:
        for each in package.infolist():
            if each.compress_type != zipfile.ZIP_STORED or each.flag_bits & 1:
                sys.exit(f"'{each.filename[:80]}' in it is compressed, which USDZ forbids")


if __name__ == "__main__":
    main(*sys.argv[1:])
