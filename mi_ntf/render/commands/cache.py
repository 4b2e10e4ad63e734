"""The command ``mi-ntf cache``, which reports and empties the user's cache."""

from typing import Any

from .. import user_cache


def report(clear: bool) -> dict[str, Any]:
    """Return the cache's ``folder``, its ``limit_mib``, and for each kind of entry its number and MiB.

    `clear`: remove all entries first, and return their MiB as ``removed_mib``.
    """
    result: dict[str, Any] = {"folder": str(user_cache.folder() or "none: the user has no home folder"),
                    "limit_mib": user_cache.FOLDER_LIMIT / 2**20}
    if clear:
        result["removed_mib"] = round(user_cache.clear() / 2**20, 1)
    entries = list(user_cache.entries())
    for kind in user_cache.KINDS:
        sizes = [status.st_size for name, _, status in entries if name == kind]
        result[kind] = {"entries": len(sizes), "mib": round(sum(sizes) / 2**20, 1)}
    return result


def print_table(result: dict[str, Any]) -> None:
    """Print the result of :func:`report`."""
    print(f"{result['folder']}, at most {result['limit_mib']:.0f} MiB")
    for kind in user_cache.KINDS:
        print(f"{kind:<8}  {result[kind]['mib']:6.0f} MiB in {result[kind]['entries']} files")
    if "removed_mib" in result:
        print(f"removed   {result['removed_mib']:6.0f} MiB")
