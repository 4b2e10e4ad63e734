"""Many tasks on several processes, machines or a cluster: :func:`run`, and :func:`each` for results as they come.

    run(work, tasks, Workers("dask", 2))

``work`` is a function of a module that takes one task and returns something small; both are pickled. What it makes it
writes itself, under another name first (:mod:`mi_ntf.core.files`): a task may be done twice, by a worker that was
thought lost or in a second attempt, and must then give the same.

Engines: ``local``, processes of this machine; ``submitit``, an array of Slurm or subprocesses; ``dask``, the workers of
a Dask scheduler or of a cluster of this machine. None is imported before it is asked for.
"""

from .options import Workers
from .running import Done, each, run

__all__ = ["Done", "Workers", "each", "run"]
