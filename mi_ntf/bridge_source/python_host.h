#pragma once

#include <filesystem>
#include <string>

/// CPython inside the stock `mitsuba` program, reached by dlsym alone: nothing here is
/// compiled against one Python version, so the same binary serves them all.
namespace mi_ntf {

/**
 * Start the environment's Python unless this process has one already, and import
 * `mi_ntf.bridge` (which imports Mitsuba without choosing a variant).
 *
 * `site_packages` is the folder that holds the `mitsuba` package. The caller must make sure
 * that only one thread is in here at a time. Where the environment has no shared libpython,
 * the process turns into `python -m mi_ntf render` with the same arguments and this call
 * does not return. Throws std::runtime_error if neither way is open.
 */
void start_python(const std::filesystem::path &site_packages);

/**
 * Let `mi_ntf.bridge.serve` register plugin `name` for `variant`; takes and releases the GIL.
 * Returns an empty string, or the text of what went wrong (with traceback where it helps).
 */
std::string register_from_python(const std::string &name, const std::string &variant);

} // namespace mi_ntf
