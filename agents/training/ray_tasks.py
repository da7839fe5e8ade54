"""Tasks on a Ray cluster, each in a process of its own, restarted when its process or node dies."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, TypeVar

Task = TypeVar("Task")
TaskResult = TypeVar("TaskResult")


def run_on_ray(work: Callable[[Task], TaskResult], tasks: Iterable[Task]) -> Iterator[tuple[Task, TaskResult]]:
    """Yield tasks and their results, in the order in which they are finished.

    The cluster is at ``RAY_ADDRESS``, else on this machine alone and ended with the work. When its process or its node
    dies, a task is restarted on another node, as often as needed: so ``work`` must go on from the files that it finds.
    As many tasks run at once as the cluster has processors; the next task is taken when one is finished.

    Raises:
        Exception: of a task; the others are then ended, too.
    """
    import ray

    ray.init(address=os.environ.get("RAY_ADDRESS", "local"), log_to_driver=False, logging_level="error")
    try:
        remote_work = ray.remote(num_cpus=1, max_retries=-1)(work)
        n_workers, waiting = max(1, int(ray.cluster_resources().get("CPU", 1))), iter(tasks)
        running: dict[Any, Task] = {}
        while True:
            running |= {remote_work.remote(task): task for task in islice(waiting, n_workers - len(running))}
            if not running:
                return
            (done, *_), _ = ray.wait(list(running))
            yield running.pop(done), ray.get(done)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    finally:
        ray.shutdown()
