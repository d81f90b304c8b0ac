"""Fixtures for every test: one torch thread, this machine's Mitsuba variants, the real data."""

import ctypes
import json
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

# Read by torch when it is first imported: sums depend on the thread count, tests must not.
os.environ["OMP_NUM_THREADS"] = "1"

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "shared: wants the real data of ../shared; set here")
    config.addinivalue_line("markers", "render: asks for a Mitsuba variant; set here")
    config.addinivalue_line("markers", "process: of a module that imports subprocess; set here")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by what they ask for, so that `-m` chooses them: `shared`, `render` and `process`."""
    for item in items:
        fixtures = getattr(item, "fixturenames", ())
        if "shared_data" in fixtures:
            item.add_marker("shared")
        if "variant" in fixtures:
            item.add_marker("render")
        if getattr(getattr(item, "module", None), "subprocess", None) is subprocess:
            item.add_marker("process")


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say the processor time of this process and of all that it waited for, which no other work changes."""
    spent = os.times()
    seconds = spent.user + spent.system + spent.children_user + spent.children_system
    terminalreporter.write_line(f"processor time: {seconds / 60:.1f} minutes")


def has_cuda() -> bool:
    """Whether a CUDA driver with at least one device is present; asked of the driver, not of torch."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0


def available_variants() -> list[str]:
    """Mitsuba variants that can run here: LLVM always (the set-up guarantees it), CUDA with a device."""
    return ["llvm_ad_rgb"] + (["cuda_ad_rgb"] if has_cuda() else [])


@pytest.fixture(scope="session", params=available_variants())
def variant(request: pytest.FixtureRequest) -> str:
    """The active Mitsuba variant. A test that touches Dr.Jit types asks for it."""
    from tron.runtime import activate

    activate(request.param)
    return request.param


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real assets, HDRIs and captures beside the repository."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no real data: {SHARED_DATA} is absent")
    return SHARED_DATA


@pytest.fixture(autouse=True)
def interruptible() -> None:
    """Give Ctrl-C Python's own handler before each test, whatever the last one or the shell has set.

    A console script ends by ignoring it, as do the children of a shell's background jobs; processes that a
    test starts would inherit that.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def drjit_threads() -> None:
    """Give Dr.Jit two threads or more before each test, whatever the last one set.

    Commands run with one thread to be reproducible; Mitsuba 3.9 reads and writes OpenEXR on Dr.Jit's worker
    threads, and where there are none it waits for ever.
    """
    if "drjit" in sys.modules:
        import drjit as dr

        threads = max(2, os.cpu_count() or 1)
        if dr.thread_count() != threads:
            dr.set_thread_count(threads)


@pytest.fixture(scope="session")
def tiny_scenes() -> list[str]:
    """Overrides of `tron-datagen` for two scenes of one small frame each, made in seconds."""
    train = [
        "scenes=2",
        "style=object",
        "lights=[overcast]",
        "frames=1",
        "width=16",
        "height=12",
        "path_spp=2",
        "guidance_spp=2",
    ]
    return [
        *(f"train.{value}" for value in train),
        *(f"{split}.scenes=0" for split in ("train_b", "validation", "test")),
        *("views=4", "view_width=24", "view_height=24", "surfels=500", "refine_steps=0"),
        *("mesh_edge=0.2", "environment_height=16", "objects=[1,1]"),
    ]


@pytest.fixture(scope="session")
def files_of() -> Callable[[Path], dict[str, bytes]]:
    """What gives every file that a recipe made in a folder, with its bytes: no lock and no log."""

    def files_of(folder: Path) -> dict[str, bytes]:
        files = {p.relative_to(folder): p for p in sorted(folder.rglob("*")) if p.is_file()}
        return {
            path.as_posix(): file.read_bytes()
            for path, file in files.items()
            if path.name != ".tron.lock" and path.parts[0] not in ("logs", "slurm")
        }

    return files_of


@pytest.fixture
def read_video() -> Callable[[Path], np.ndarray]:
    """All frames of a video, (N, H, W, 3) uint8."""
    import av

    def read(path: Path) -> np.ndarray:
        with av.open(str(path)) as container:
            return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])

    return read


@pytest.fixture(scope="session")
def write_glb() -> Callable[[Path, dict[str, Any], Sequence[Any]], Path]:
    """Writes a GLB of a tree and what its buffer views hold; arrays get accessors of the same numbers.

    Arrays come first, then bytes. Node 0 holds mesh 0 where the tree has no nodes.
    """
    widths = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
    kinds = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}

    def write(path: Path, tree: dict[str, Any], blobs: Sequence[Any]) -> Path:
        data, views, accessors = b"", [], []
        for blob in blobs:
            content = blob if isinstance(blob, bytes) else np.ascontiguousarray(blob).tobytes()
            views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content)})
            data += content + bytes(-len(content) % 4)
            if not isinstance(blob, bytes):
                shape = (*np.shape(blob), 1)
                kind = {"componentType": kinds[blob.dtype.str[1:]], "type": widths[shape[1]]}
                accessors.append({"bufferView": len(views) - 1, "count": shape[0]} | kind)
        whole = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        whole |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}]} | tree
        text = json.dumps(whole).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<2I", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<2I", len(data), 0x004E4942) + data
        path.write_bytes(struct.pack("<3I", 0x46546C67, 2, 12 + len(chunks)) + chunks)
        return path

    return write


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """`made_once(name, make)`: a folder that the first process of a session fills by `make`, for all of them.

    Processes of pytest-xdist have folders of their own beside each other. Nobody may write into what is made.
    """
    own = tmp_path_factory.getbasetemp()
    shared = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def made(name: str, make: Callable[[Path], None]) -> Path:
        folder, done = shared / f"once-{name}", shared / f"once-{name}.done"
        with FileLock(shared / f"once-{name}.lock"):
            if not done.exists():
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def tiny_captures(made_once) -> Path:
    """Folder of three captures, path-traced, with true maps: 9 views of 24 x 24, two of them held out."""
    from datagen.run.captures import make_captures
    from datagen.settings.command import Settings
    from tron.cli.recipes import check, compose_recipe

    wanted = [
        *("mode=captures", "cluster=none", "seed=77", "test.style=object"),
        *("capture.scenes=3", "capture.views=9", "capture.width=24", "capture.height=24"),
        *("capture.path_spp=9", "capture.reference_spp=2", "mesh_edge=0.2", "environment_height=16"),
        *("texels_per_unit=16", "objects=[2,2]"),
    ]

    def make(output: Path) -> None:
        recipe = compose_recipe("conf.datagen", Settings, [*wanted, f"output_dir={output}"])
        assert make_captures(check(recipe, Settings)) == 0

    return made_once("tiny_captures", make) / "captures"


@pytest.fixture(scope="session")
def quick_reconstruction() -> list[str]:
    """Overrides of `tron-datagen source=captured` for captures with true maps, made in seconds each."""
    surfels = [
        *("steps_scaler=1", "checkpoint_every=4", "initial.source=depth", "initial.count=400"),
        *("radiance.steps=10", "radiance.density.most=400", "radiance.consistency.most_voxels=16"),
        "materials.steps=4",
    ]
    light = [
        *("steps=6", "resolution=8", "rays=4", "pixels=64", "scale_steps=3", "scale_pixels=256"),
        *("scale_rays=4", "split_sum_resolution=64"),
    ]
    return [
        *("captured.frames=3", "captured.width=20", "captured.height=16", "captured.guidance_spp=2"),
        *(f"captured.reconstruction.{value}" for value in surfels),
        *(f"captured.light.{value}" for value in light),
    ]


@pytest.fixture(scope="session")
def pair_words(tiny_captures: Path, quick_reconstruction: list[str]) -> list[str]:
    """Overrides of `tron-datagen` for the pairs of the tiny captures, made in this process."""
    words = ["source=captured", f"captures={tiny_captures}", "prior=ground_truth", "cluster=none"]
    return [*words, *quick_reconstruction]


def make_dataset(words: Sequence[str], output: Path) -> None:
    from datagen.run.dataset import make
    from datagen.settings.command import Settings
    from tron.cli.recipes import check, compose_recipe

    recipe = compose_recipe("conf.datagen", Settings, [*words, f"output_dir={output}"])
    assert make(check(recipe, Settings)) == 0


@pytest.fixture(scope="session")
def tiny_dataset(variant: str, made_once, tiny_scenes: list[str]) -> Path:
    """The two tiny scenes as one process makes them; nobody writes into it."""
    words = [*tiny_scenes, "cluster=none"]
    return made_once(f"tiny_dataset-{variant}", lambda output: make_dataset(words, output))


@pytest.fixture(scope="session")
def tiny_pairs(variant: str, made_once, pair_words: list[str]) -> Path:
    """The pairs of the three tiny captures, one a split; nobody writes into it."""
    return made_once(f"tiny_pairs-{variant}", lambda output: make_dataset(pair_words, output))


@pytest.fixture(scope="session")
def live_memory() -> Any:
    """Class of a context that counts bytes of tensors alive at once, the same on every machine.

    ``live_memory()`` has ``live`` and ``peak``. What was there before is not counted, nor are an
    allocator's rounding and an operation's own scratch space. Inside torch's FakeTensorMode it counts a
    pass without doing it.
    """
    import weakref

    from torch import Tensor
    from torch.utils._python_dispatch import TorchDispatchMode
    from torch.utils._pytree import tree_leaves

    def storages(tensors: Any) -> list[Any]:
        return [leaf.untyped_storage() for leaf in tree_leaves(tensors) if isinstance(leaf, Tensor)]

    class LiveMemory(TorchDispatchMode):
        def __init__(self) -> None:
            super().__init__()
            self.live = self.peak = 0
            self.seen: set[int] = set()

        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            given = {storage._cdata for storage in storages((args, kwargs))}
            outputs = func(*args, **(kwargs or {}))
            for storage in storages(outputs):
                if storage._cdata not in given | self.seen:  # neither a view nor an update in place
                    size = storage.nbytes()
                    self.seen.add(storage._cdata)
                    self.live += size
                    self.peak = max(self.peak, self.live)
                    weakref.finalize(storage, self.forget, storage._cdata, size)
            return outputs

        def forget(self, key: int, size: int) -> None:
            self.seen.discard(key)
            self.live -= size

    return LiveMemory


@pytest.fixture(scope="session")
def vgg16_features() -> Callable[[], Any]:
    """torchvision's vgg16().features with random weights, written anew from the paper's configuration D."""
    import torch

    def made() -> torch.nn.Sequential:
        layers: list[torch.nn.Module] = []
        channels = 3
        for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0):
            if width == 0:
                layers.append(torch.nn.MaxPool2d(2, 2))
                continue
            convolution = torch.nn.Conv2d(channels, width, 3, padding=1)
            torch.nn.init.kaiming_normal_(convolution.weight)
            torch.nn.init.normal_(convolution.get_parameter("bias"), std=0.1)
            layers += [convolution, torch.nn.ReLU()]
            channels = width
        return torch.nn.Sequential(*layers)

    return made


@pytest.fixture(scope="session")
def random_vgg(tmp_path_factory: pytest.TempPathFactory, vgg16_features: Callable[[], Any]) -> Path:
    """A file like torchvision's vgg16-397923af.pth, with random weights."""
    import torch

    torch.manual_seed(0)
    state = {f"features.{name}": value for name, value in vgg16_features().state_dict().items()}
    path = tmp_path_factory.mktemp("vgg") / "vgg16.pth"
    torch.save({**state, "classifier.0.weight": torch.zeros(2)}, path)
    return path
