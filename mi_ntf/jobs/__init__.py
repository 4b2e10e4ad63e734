"""Many tasks on several processes, machines or a cluster: :func:`run`, and :func:`each` for results as they come.

    run(work, tasks, Workers("dask", 2))

``work`` is a function of a module that takes one task and returns something small; both are pickled. It writes its
files itself, under another name first (:mod:`mi_ntf.core.files`). A task may run twice, on a worker that was thought
lost or in a second attempt, and must then give the same result.

The engine ``local`` uses processes of this machine, ``submitit`` an array of Slurm jobs or subprocesses, and ``dask``
the workers of a Dask scheduler or a cluster of this machine. An engine is imported only when it is needed.
"""

from .options import Workers
from .running import Done, each, run

__all__ = ["Done", "Workers", "each", "run"]
