"""Plans of a cluster's work, laid out for reading."""

from collections.abc import Sequence

from clra.app.cost import columns, size
from clra.app.planning.cluster_plan import Plan, Site
from clra.app.planning.planned_steps import Workers
from clra.app.progress_bar import duration

# Slowdown by others on the same core that is worth telling.
_SHARED = 1.2


def plan_table(plans: Sequence[Plan], workers: Workers) -> str:
    """Lay plans out for reading, with what they assume.

    Parameters
    ----------
    plans : sequence of Plan
        Of one cluster.
    workers : Workers
        That were planned for.
    """
    head = ("cluster", "tasks", "read", "written", "messages", "time", "efficiency", "limited by")
    rows: list[tuple[str, ...]] = [head]
    rows += [(plan.work, *cells(plan)) for plan in plans]
    site = Site()
    slow = workers.slowdown
    shared = f" and a core that is {slow:.1f} times shared" if slow > _SHARED else ""
    return "\n".join(
        [
            *columns(rows),
            "",
            f"For {workers.count} workers, each with {workers.speed.device} that holds slabs of "
            f"{size(workers.slab_bytes)}{shared}; a shared file system of "
            f"{site.file_system / 1e9:g} GB/s, {site.link / 1e9:g} GB/s a worker, is assumed.",
        ]
    )


def cells(plan: Plan) -> tuple[str, ...]:
    """Return the numbers of a plan: tasks, bytes, time, efficiency and what limits it."""
    return (
        str(plan.tasks),
        size(plan.read_bytes),
        size(plan.written_bytes),
        size(plan.message_bytes),
        duration(plan.seconds),
        f"{plan.efficiency:.0%}",
        plan.limit,
    )
