"""Client of a vision model behind an OpenAI-compatible endpoint, with bounded retries.

It sends chat completions with two PNG pictures by the package ``openai``, which retries after time-outs,
refused connections, 429 and 5xx. Size and time of replies are always bounded.
"""

from __future__ import annotations

import asyncio
import base64
import importlib
import json
import logging
import os
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from eval.judge.prompt import PROMPT, Answer, read_answer
from tron.errors import TronError

LARGEST_REPLY = 2**20
NO_KEY = "none"
"""Sent where the environment has no key: servers of one's own want none, but the header must be there."""


class NoAnswer(Exception):
    """The endpoint did not answer a question; str() says why. Another question may be answered."""


@dataclass(frozen=True)
class Endpoint:
    """Address, model and limits of the judge.

    Attributes:
        url: base, such as https://api.openai.com/v1.
        model: name of the model.
        key_variable: environment variable with the API key.
        timeout: time limit of one try, seconds.
        retries: tries after the first.
    """

    url: str
    model: str
    key_variable: str
    timeout: float
    retries: int

    def check(self) -> None:
        """Raise TronError if the address is invalid or has a password, or ``openai`` is not installed."""
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise TronError(
                f"not an address: {self.url}",
                "benchmark.endpoint",
                "give https://HOST/v1, as its manual says",
            )
        if parts.username or parts.password or parts.query:
            mend = f"put the key into the environment variable {self.key_variable}"
            raise TronError("the address holds a key or a password", "benchmark.endpoint", mend)
        require_openai()

    def client(self) -> Any:
        """Return an ``AsyncOpenAI``; close it by ``async with``."""
        logging.getLogger("httpx2").setLevel(logging.WARNING)  # which reports every request
        return require_openai().AsyncOpenAI(
            base_url=self.url,
            api_key=os.environ.get(self.key_variable) or NO_KEY,
            timeout=self.timeout,
            max_retries=self.retries,
        )

    async def ask(self, client: Any, seed: int, first: bytes, second: bytes) -> tuple[Answer | None, str]:
        """Return the answer about two PNG pictures and the reply's text; ask again after an invalid reply.

        Raises:
            TronError: the endpoint refuses such questions, whatever the pictures.
            NoAnswer: nothing came in all tries.
        """
        said = ""
        for _ in range(self.retries + 1):
            said = await self._reply(client, seed, first, second)
            if (answer := read_answer(said)) is not None:
                return answer, said
        return None, said

    async def _reply(self, client: Any, seed: int, first: bytes, second: bytes) -> str:
        """Return the text of one reply, whatever it says."""
        openai = require_openai()
        content: list[dict[str, Any]] = [{"type": "text", "text": PROMPT}]
        for name, picture in (("A", first), ("B", second)):
            data = "data:image/png;base64," + base64.b64encode(picture).decode()
            content += [
                {"type": "text", "text": f"Image {name}:"},
                {"type": "image_url", "image_url": {"url": data}},
            ]
        asked = client.chat.completions.with_streaming_response.create(
            model=self.model, seed=seed, messages=[{"role": "user", "content": content}]
        )
        body = bytearray()
        try:
            # the client's time-out is of one read: a server that drips bytes would never meet it
            async with asyncio.timeout(self.timeout * (self.retries + 1)), asked as response:
                async for part in response.iter_bytes(2**16):
                    body += part
                    if len(body) > LARGEST_REPLY:
                        raise NoAnswer(f"its reply is longer than {LARGEST_REPLY} bytes")
        except (openai.APITimeoutError, TimeoutError) as error:
            raise NoAnswer(f"no reply within {self.timeout:g} s, {self.retries + 1} times") from error
        except openai.APIStatusError as error:
            code = error.status_code
            if code in (408, 409, 429) or code >= 500:
                raise NoAnswer(f"it said {code} {self.retries + 1} times") from error
            key = f", or set {self.key_variable}" if code in (401, 403) else ""
            mend = f"look at benchmark.endpoint and benchmark.model{key}"
            raise TronError(f"the judge refuses: {code} {self._message(error)}", self.url, mend) from error
        except openai.OpenAIError as error:
            raise NoAnswer(f"no connection: {error.__cause__ or error}") from error
        return _text(bytes(body))

    def _message(self, error: Any) -> str:
        """Return the endpoint's message about a refusal, without our key."""
        said = str(getattr(error, "message", ""))[:200]
        return said.replace(os.environ.get(self.key_variable) or NO_KEY, "***")


def _text(body: bytes) -> str:
    """Return the text of a chat completion; any other reply is returned as text, and is no answer."""
    try:
        return str(json.loads(body)["choices"][0]["message"]["content"])
    except (ValueError, LookupError, TypeError, RecursionError):
        return "no chat completion: " + body[:100].decode(errors="replace")


def require_openai() -> Any:
    """Import the package ``openai``; TronError if it is not installed."""
    try:
        return importlib.import_module("openai")
    except ImportError as error:
        raise TronError("a judge needs openai", mend="pip install 'tron-relight[judge]'") from error
