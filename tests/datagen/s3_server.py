"""moto's S3 server on a free port of this machine, and what tests do to it behind the data engine's back."""

import socket
from pathlib import PurePosixPath

import boto3
import fsspec
import pytest
from moto.server import ThreadedMotoServer


class S3Server:
    """A server that can be stopped and started again on the same port; then it is empty.

    Attributes:
        address: http://127.0.0.1:PORT.
    """

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address = f"http://127.0.0.1:{self._port}"
        self._count = 0
        self.start()

    def start(self) -> None:
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
        name = url.removeprefix("s3://") if url else f"tron-{self._count}"
        client = self._client()
        if name not in [each["Name"] for each in client.list_buckets()["Buckets"]]:
            client.create_bucket(Bucket=name)
        return f"s3://{name}"

    def write(self, url: str, data: bytes) -> None:
        bucket, _, key = url.removeprefix("s3://").partition("/")
        self._client().put_object(Bucket=bucket, Key=key, Body=data)

    def times(self, url: str) -> dict[str, str]:
        """When each object was written, by its name."""
        bucket, _, key = url.removeprefix("s3://").partition("/")
        listed = self._client().list_objects_v2(Bucket=bucket, Prefix=key)["Contents"]
        return {PurePosixPath(each["Key"]).name: each["LastModified"].isoformat() for each in listed}

    def point_to(self, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """Let clients look for the store elsewhere."""
        monkeypatch.setenv("AWS_ENDPOINT_URL", address)
        fsspec.get_filesystem_class("s3").clear_instance_cache()

    def _client(self):
        return boto3.client("s3", endpoint_url=self.address)
