"""The processes of a training run, one for each device, started here, by torchrun or by Slurm.

Lightning's own launcher runs the command line again and kills processes without a message. Here they are
spawned from the checked settings and watched: if one ends, all end, and the reason is reported.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import lightning
import torch
from lightning.fabric.plugins.environments.lightning import find_free_network_port
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning.fabric.utilities.exceptions import MisconfigurationException
from torch import distributed
from torch.multiprocessing.spawn import ProcessExitedException, ProcessRaisedException, start_processes

from train.settings import Settings
from tron.cli.command_line import INTERRUPTED, USER_ERROR
from tron.cli.log import configure_logging
from tron.errors import TronError
from tron.termination import TERMINATED, termination_unwinds

GRACE_SECONDS = 15.0
"""Seconds in which the other processes may end by themselves after one has failed or was interrupted."""
CHECKPOINT_SECONDS = 120.0
"""Seconds that processes have to finish their step and write a checkpoint after SIGTERM or Ctrl-C."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class Processes:
    """This process's rank among the training processes, and the exchange between their CPUs."""

    rank: int = 0
    count: int = 1
    group: Any = None

    @property
    def first(self) -> bool:
        """Whether this is global rank 0, the only one that locks, writes and logs."""
        return self.rank == 0

    def from_first(self, work: Callable[[], Result]) -> Result:
        """Run `work` in the first process and return its result in all; its TronError ends all processes."""
        outcome = [_outcome(work) if self.first else None]
        if self.count > 1:
            distributed.broadcast_object_list(outcome, src=0, group=self.group)
        return self._unless_failed(outcome[0], [outcome[0]])

    def together(self, work: Callable[[], Result]) -> Result:
        """Run `work` in every process and return this one's result; a TronError in any ends all."""
        own = _outcome(work)
        failures: list[Any] = [own if isinstance(own, TronError) else None] * self.count
        if self.count > 1:
            distributed.all_gather_object(failures, failures[0], group=self.group)
        return self._unless_failed(own, failures)

    def number_of_first(self, number: float) -> float:
        """The first process's number, in every process."""
        if self.count == 1:
            return number
        shared = torch.tensor(number, dtype=torch.float64)
        distributed.broadcast(shared, src=0, group=self.group)
        return shared.item()

    def _unless_failed(self, outcome: Any, failures: list[Any]) -> Any:
        error = next((each for each in failures if isinstance(each, TronError)), None)
        if error is None:
            return outcome
        if self.first:
            raise error
        raise SystemExit(USER_ERROR)  # one process logs it


def _outcome(work: Callable[[], Result]) -> Result | TronError:
    try:
        return work()
    except TronError as error:
        return error


def launch(work: Callable[[Processes, Settings], None], settings: Settings) -> None:
    """Do `work` in every process of a run: this one, new ones, or those that torchrun or srun has started.

    Raises:
        TronError: this machine lacks the devices, nodes, accelerator or precision; or any process raised
            one.
        KeyboardInterrupt: a process was interrupted; all have ended.
    """
    _quiet_lightning()
    with termination_unwinds():
        _launch(work, settings)


def _launch(work: Callable[[Processes, Settings], None], settings: Settings) -> None:
    outer = _outer_launcher()
    devices = _devices(settings, outer)
    if outer is not None:
        count = outer.world_size()
        if devices * settings.nodes != count:
            raise TronError(
                f"{count} processes were started, but devices={devices} on nodes={settings.nodes} are "
                f"{devices * settings.nodes}",
                mend="start one process for each device (torchrun --nproc-per-node, srun --ntasks-per-node)",
            )
        with _joined(settings, devices) as processes:
            work(processes, settings)
    elif devices * settings.nodes == 1:
        work(Processes(), settings)
    else:
        _spawn(work, settings, devices)


def _outer_launcher() -> Any:
    """Lightning's view of torchrun or Slurm, where one of them has started this process."""
    if TorchElasticEnvironment.detect():
        return TorchElasticEnvironment()
    try:
        return SLURMEnvironment() if SLURMEnvironment.detect() else None
    except RuntimeError as error:  # srun options that Lightning does not follow
        raise TronError("cannot train under this srun", mend=str(error)) from error


def _devices(settings: Settings, outer: Any) -> int:
    """Number of this machine's devices to train on; TronError if it has fewer."""
    fabric = _fabric(settings, settings.devices, 1)
    on_cpu = fabric.device.type == "cpu"
    if settings.devices == "auto" and on_cpu and outer is not None:
        return max(1, outer.world_size() // settings.nodes)
    devices = getattr(fabric.strategy, "num_processes", 1)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if on_cpu and devices > cores and outer is None:
        raise TronError(f"devices={devices} of accelerator cpu", mend=f"this machine has {cores} cores")
    return devices


def _fabric(settings: Settings, devices: int | str, nodes: int, **more: Any) -> lightning.Fabric:
    try:
        return lightning.Fabric(
            accelerator=settings.accelerator,
            devices=devices,
            num_nodes=nodes,
            precision=settings.precision,
            **more,
        )
    except (MisconfigurationException, ValueError, RuntimeError) as error:
        asked = (
            f"devices={settings.devices} accelerator={settings.accelerator} precision={settings.precision}"
        )
        raise TronError(f"cannot train on {asked}", mend=str(error)) from error


@contextmanager
def _joined(settings: Settings, devices: int) -> Iterator[Processes]:
    """Join the run's process group, which ends with the block."""
    if devices * settings.nodes == 1:
        yield Processes()
        return
    if settings.threads is not None:  # else Lightning would divide all cores among this machine's processes
        os.environ["OMP_NUM_THREADS"] = str(settings.threads)
    fabric = _fabric(settings, devices, settings.nodes, strategy="ddp")
    fabric.launch()
    processes = Processes(fabric.global_rank, fabric.world_size, distributed.new_group(backend="gloo"))
    if processes.first:
        configure_logging()
    else:  # it would only repeat the first one's lines
        logging.getLogger().setLevel(logging.ERROR)
        warnings.simplefilter("ignore")
    try:
        yield processes
    finally:  # gloo's threads, left running, abort the interpreter as it ends
        # Garbage that holds a group, collected after this, waits for a thread that waits for the interpreter.
        gc.collect()
        distributed.destroy_process_group()


def _spawn(work: Callable[[Processes, Settings], None], settings: Settings, devices: int) -> None:
    """Start this machine's processes and wait for them; if one fails, end all with its error."""
    if settings.nodes > 1:
        raise TronError(f"nodes={settings.nodes} without a launcher", mend="start it by torchrun or srun")
    port = str(find_free_network_port())
    shared = {"WORLD_SIZE": str(devices), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "NODE_RANK": "0"}
    errors = torch.multiprocessing.get_context("spawn").SimpleQueue()
    context = start_processes(
        _spawned, (work, settings, devices, shared, errors), nprocs=devices, join=False, start_method="spawn"
    )
    assert context is not None
    try:
        while not context.join(grace_period=GRACE_SECONDS):
            pass
    except (ProcessRaisedException, ProcessExitedException) as error:
        if not errors.empty():
            raise errors.get() from None
        if isinstance(error, ProcessRaisedException):
            raise
        if error.exit_code == INTERRUPTED:
            raise KeyboardInterrupt from error
        if error.exit_code == TERMINATED:
            raise SystemExit(TERMINATED) from error
        raise TronError(
            f"training {error}",
            mend="if that was for want of memory, make batch_size or data.cache_gb smaller",
        ) from error
    except (SystemExit, KeyboardInterrupt) as asked:
        # They finish their step, write a checkpoint, and handle later signals themselves.
        number = signal.SIGINT if isinstance(asked, KeyboardInterrupt) else signal.SIGTERM
        before = signal.signal(number, lambda *_: _tell(context.processes, number))
        _end(context.processes, number, CHECKPOINT_SECONDS)
        signal.signal(number, before)
        raise
    finally:
        _end(context.processes, signal.SIGINT, GRACE_SECONDS)


def _end(processes: list[Any], gently: signal.Signals, grace: float) -> None:
    """Terminate the running processes, and kill those that do not end."""
    for number, seconds in ((gently, grace), (signal.SIGKILL, None)):
        running = _tell(processes, number)
        deadline = None if seconds is None else time.monotonic() + seconds
        for process in running:
            process.join(None if deadline is None else max(0.0, deadline - time.monotonic()))


def _tell(processes: list[Any], number: signal.Signals) -> list[Any]:
    """Send a signal to the running processes and return them."""
    running = [process for process in processes if process.is_alive()]
    for process in running:
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.kill(process.pid, number)
    return running


def _spawned(
    local_rank: int,
    work: Callable[[Processes, Settings], None],
    settings: Settings,
    devices: int,
    environment: dict[str, str],
    errors: Any,
) -> None:
    os.environ.update(environment, LOCAL_RANK=str(local_rank))
    _quiet_lightning()
    try:
        with termination_unwinds(), _joined(settings, devices) as processes:
            work(processes, settings)
    except TronError as error:
        errors.put(error)
        raise SystemExit(USER_ERROR) from error
    except KeyboardInterrupt as error:
        raise SystemExit(INTERRUPTED) from error


def _quiet_lightning() -> None:
    """Silence Lightning's start-up lines and its advice on loaders."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.fabric").setLevel(logging.WARNING)
    for message in (
        ".*does not have many workers.*",
        ".*Checkpoint directory.*",
        ".*IterableDataset.*",
        ".*`srun` command is available.*",
        ".*`broadcast_buffers` is deprecated.*",  # what torch has instead is not in 2.6
        ".*LeafSpec.*",
        ".*returned a view tensor.*",  # of FSDP2; nothing is done in place to a renderer's picture
    ):
        warnings.filterwarnings("ignore", message)
