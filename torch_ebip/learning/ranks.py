"""The processes of one run: who does what, and what they tell each other.

Started by `torchrun`, a run has several processes with a rank each; otherwise it has one, and nothing here costs
anything. Processes talk through torch.distributed: gloo between CPUs, nccl between GPUs.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import timedelta
from types import FrameType
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

T = TypeVar("T")


class RankLostError(RuntimeError):
    """Another process of the run ended, so that this one cannot go on."""


class Ranks:
    """This process among those of a run.

    Attributes:
        rank: number of this process, from 0.
        size: how many there are.
        device: where this process computes: its GPU if there is one, otherwise the CPU.
    """

    def __init__(self, rank: int = 0, size: int = 1, device: torch.device | None = None) -> None:
        self.rank, self.size = rank, size
        self.device = torch.device("cpu") if device is None else device

    @classmethod
    def start(cls) -> Ranks:
        """The ranks that `torchrun` gave this process; a single one where it did not start it.

        Threads that torch uses are divided among the processes of this machine.
        """
        local, locals_ = int(os.environ.get("LOCAL_RANK", 0)), int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        gpus = torch.cuda.device_count()
        device = torch.device("cuda", local % gpus) if gpus else torch.device("cpu")
        if "TORCHELASTIC_RUN_ID" not in os.environ:
            return cls(0, 1, device)
        torch.set_num_threads(max(1, (os.cpu_count() or 1) // locals_))
        if gpus:
            torch.cuda.set_device(device)
        loopback = {"linux": "lo", "darwin": "lo0"}.get(sys.platform)
        if loopback is not None and os.environ["WORLD_SIZE"] == str(locals_):
            # Processes of one machine listen for each other there, unless gloo is told otherwise. The store that
            # torchrun itself keeps listens on all addresses.
            os.environ.setdefault("GLOO_SOCKET_IFNAME", loopback)
        # A process may wait for another's folds for long; that one has died is noticed by its closed connection.
        dist.init_process_group("cpu:gloo,cuda:nccl" if gpus >= locals_ else "gloo", timeout=timedelta(days=7))
        return cls(dist.get_rank(), dist.get_world_size(), device)

    def stop(self) -> None:
        """Leave the group, together; call it when everything is done."""
        if dist.is_available() and dist.is_initialized():
            with suppress(RankLostError):  # what was to be said has been said
                self._talk(dist.barrier)
            dist.destroy_process_group()

    @property
    def first(self) -> bool:
        """Whether this is the process that writes and speaks."""
        return self.rank == 0

    def shard(self, items: Sequence[T]) -> list[T]:
        """This process's part of some items: every ``size``-th, from its own number on."""
        return list(items[self.rank :: self.size])

    def mean(self, values: Mapping[str, float], weight: float) -> dict[str, float]:
        """Mean over the processes of each of some values, with the weight of each process; the same names everywhere.

        Raises:
            RankLostError: another process ended.
        """
        if self.size == 1:
            return dict(values)
        numbers = torch.tensor([*values.values(), 1.0], dtype=torch.float64, device="cpu") * weight
        self._sum(numbers)
        return dict(zip(values, (numbers[:-1] / numbers[-1]).tolist(), strict=True))

    def add_up(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor [...] by its sum over the processes, in one message.

        Raises:
            RankLostError: another process ended.
        """
        if self.size == 1 or not tensors:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        self._sum(flat)
        for tensor, part in zip(tensors, torch.split(flat, [tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def gather(self, item: T) -> list[T]:
        """What every process has, by rank, on all of them.

        Raises:
            RankLostError: another process ended.
        """
        if self.size == 1:
            return [item]
        items: list[Any] = [None] * self.size
        self._talk(lambda: dist.all_gather_object(items, item))
        return items

    def from_first(self, make: Callable[[], T]) -> T:
        """What ``make`` gives on the first process, on all of them; what it raises there, SystemExit here.

        Raises:
            SystemExit: the first process could not make it.
            RankLostError: another process ended.
        """
        if self.size == 1:
            return make()
        made: list[Any] = [None, None]
        failure: BaseException | None = None
        if self.first:
            try:
                made[0] = make()
            except (Exception, SystemExit) as error:
                failure, made[1] = error, "the first process stopped"
        self._talk(lambda: dist.broadcast_object_list(made))
        if failure is not None:
            raise failure
        if made[1] is not None:
            raise SystemExit(made[1])
        return made[0]  # type: ignore[no-any-return]

    def explain_on_termination(self, message: str) -> None:
        """Say something when `torchrun` ends this process because another one died."""
        if self.size == 1:
            return

        def leave(number: int, frame: FrameType | None) -> None:
            """Speak, and go without clearing up after a group that is no more."""
            os.write(2, f"\nprocess {self.rank}: {message}\n".encode())
            os._exit(1)

        signal.signal(signal.SIGTERM, leave)

    def _sum(self, tensor: Tensor) -> None:
        self._talk(lambda: dist.all_reduce(tensor))

    def _talk(self, speak: Callable[[], object]) -> None:
        try:
            speak()
        except RuntimeError as error:
            raise RankLostError(f"no word from the other processes of this run ({error})") from error
