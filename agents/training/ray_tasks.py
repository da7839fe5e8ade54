"""Work on a Ray cluster: pieces in processes of their own, on whatever node has room."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, TypeVar

Task = TypeVar("Task")


def run_on_ray(work: Callable[[Task], Any], tasks: Iterable[Task]) -> Iterator[tuple[Task, Any]]:
    """Tasks and what the work made of them, in the order in which they are finished.

    The cluster is that of ``RAY_ADDRESS``, else one of this machine's own, which ends with the work. A task is begun
    anew on another node, as often as needed, when its process or its node dies; so the work must go on with what it
    finds. As many tasks are under way as the cluster has processors; the next is taken when one is finished.

    Raises:
        Exception: what a task raises; the others are then ended, too.
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
