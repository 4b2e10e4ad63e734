"""``mi-ntf cache``: what the user's cache holds."""

from .. import user_cache


def report(clear: bool) -> dict:
    """Return the cache's ``folder``, its ``limit_mib``, and for each kind of entry its number and MiB.

    `clear`: remove all entries; ``removed_mib`` tells how much that was.
    """
    result: dict = {"folder": str(user_cache.folder() or "none: the user has no home folder"),
                    "limit_mib": user_cache.FOLDER_LIMIT / 2**20}
    if clear:
        result["removed_mib"] = round(user_cache.clear() / 2**20, 1)
    found = list(user_cache.entries())
    for kind in user_cache.KINDS:
        sizes = [status.st_size for name, _, status in found if name == kind]
        result[kind] = {"entries": len(sizes), "mib": round(sum(sizes) / 2**20, 1)}
    return result
