"""A small dataset of three splits, made once for all tests that read one."""

import socket
from pathlib import Path

import fsspec
import pytest

from datagen.run.dataset import make
from datagen.settings.command import Settings
from tron.cli.recipes import check, compose_recipe

SMALL = [
    *("train.scenes=2", "train_b.scenes=1", "validation.scenes=0", "test.scenes=1", "seed=5"),
    *("views=6", "view_width=32", "view_height=32", "surfels=1500", "refine_steps=3", "mesh_edge=0.2"),
    *("environment_height=16", "path_frames=8", "cluster=none"),
    *("train.lights=[sun,overcast]", "train_b.lights=[studio]", "test.lights=[sun,studio]"),
    *(
        f"{split}.{value}"
        for split in ("train", "train_b", "test")
        for value in (
            *("style=object", "frames=3", "width=32", "height=24"),
            *("path_spp=4", "guidance_spp=4", "reference_spp=4"),
        )
    ),
]


def small(output: Path, *overrides: str) -> Settings:
    """Settings of the small dataset."""
    return check(
        compose_recipe("conf.datagen", Settings, [*SMALL, f"output_dir={output}", *overrides]), Settings
    )


@pytest.fixture(scope="session")
def small_settings():
    return small


@pytest.fixture(scope="session")
def small_dataset(variant: str, made_once) -> Path:
    """Four scenes, seven clips of three frames, 32 x 24; nobody writes into it."""

    def fill(output: Path) -> None:
        assert make(small(output)) == 0

    return made_once(f"small_dataset_{variant}", fill)


CLIENT = {
    "AWS_ACCESS_KEY_ID": "tron-test-key",
    "AWS_SECRET_ACCESS_KEY": "tron-test-secret",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_MAX_ATTEMPTS": "1",
}


class S3Server:
    """moto's S3 server on a free port, and what tests do to it behind the data engine's back.

    It can be stopped and started again on the same port, and is empty then. `address` is http://127.0.0.1:PORT.
    """

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address = f"http://127.0.0.1:{self._port}"
        self._count = 0
        self.start()

    def start(self) -> None:
        from moto.server import ThreadedMotoServer

        self._server = ThreadedMotoServer("127.0.0.1", self._port, verbose=False)
        self._server.start()
        self._running = True

    def stop(self) -> None:
        if self._running:
            self._server.stop()
            self._running = False

    def bucket(self, url: str | None = None) -> str:
        """URL of a new bucket, or of that one again."""
        self._count += 1
        url = url or f"s3://tron-{self._count}"
        if not self._files().exists(url):
            self._files().mkdir(url)
        return url

    def write(self, url: str, data: bytes) -> None:
        self._files().pipe_file(url, data)

    def times(self, url: str) -> dict[str, str]:
        """When each file was written, by its name."""
        listed = self._files().ls(url, detail=True)
        return {
            each["name"].rpartition("/")[2]: str(each["LastModified"])
            for each in listed
            if each["type"] == "file"
        }

    def point_to(self, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """Let clients look for the store there."""
        monkeypatch.setenv("AWS_ENDPOINT_URL", address)
        fsspec.get_filesystem_class("s3").clear_instance_cache()

    def _files(self):
        import s3fs

        return s3fs.S3FileSystem(endpoint_url=self.address, skip_instance_cache=True)


@pytest.fixture(scope="session")
def running_s3():
    """moto's S3 server, for the session."""
    pytest.importorskip("moto.server", reason="no S3 server: pip install 'moto[server]'")
    pytest.importorskip("s3fs", reason="no S3 client: pip install s3fs")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in CLIENT.items():
            patch.setenv(name, value)
        server = S3Server()
        yield server
        server.stop()


@pytest.fixture
def s3_server(running_s3, monkeypatch: pytest.MonkeyPatch):
    """The server, running, with the environment of a client that finds it."""
    running_s3.stop()
    running_s3.start()
    for name, value in CLIENT.items():
        monkeypatch.setenv(name, value)
    running_s3.point_to(running_s3.address, monkeypatch)
    return running_s3
