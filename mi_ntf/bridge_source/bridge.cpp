/**
 * Entry point that Mitsuba's plugin manager looks for. This one source is built once and
 * installed under the name of every plugin that is written in Python.
 *
 * `init_plugin` registers a native factory for every variant. The factory lets Python call
 * `mi.register_*`, which replaces the native entry of that name and variant, and creates the
 * object again with the same properties: from there on Mitsuba deals with an ordinary plugin.
 *
 * Locks: `init_plugin` runs with the plugin manager's mutex held. It may take the GIL only
 * while it starts Python, when nobody else can have it; otherwise a thread that holds
 * the GIL and registers a plugin would wait for the mutex, and this one for the GIL.
 */
#include "python_host.h"

#include <drjit-core/jit.h>
#include <mitsuba/core/filesystem.h>
#include <mitsuba/core/fresolver.h>
#include <mitsuba/core/logger.h>
#include <mitsuba/core/plugin.h>
#include <mitsuba/core/properties.h>
#include <mitsuba/core/util.h>

#include <array>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>

using namespace mitsuba;

namespace {

constexpr std::string_view variants = MI_VARIANTS;           // names, each ended by a newline

constexpr size_t variant_count() {
    size_t count = 0;
    for (char c : variants)
        count += c == '\n';
    return count;
}

constexpr std::string_view variant_name(size_t index) {
    std::string_view rest = variants;
    for (; index > 0; --index)
        rest.remove_prefix(rest.find('\n') + 1);
    return rest.substr(0, rest.find('\n'));
}

/// Importing Mitsuba in Python resets these globals of the running program: put them back.
class KeepProgramState {
public:
    ~KeepProgramState() {
        set_file_resolver(m_resolver.get());
        set_logger(m_logger.get());
        jit_set_log_level_stderr(m_level);
        jit_set_log_level_callback(::LogLevel::Disable, nullptr);
    }

private:
    ref<FileResolver> m_resolver = file_resolver();
    ref<Logger> m_logger = logger();
    ::LogLevel m_level = jit_log_level_stderr();
};

template <size_t Variant> ref<Object> create(void *, const Properties &props) {
    static thread_local const Properties *in_progress = nullptr;
    std::string name(props.plugin_name()), variant(variant_name(Variant));
    if (in_progress == &props)
        throw std::runtime_error("mi_ntf registered no plugin \"" + name + "\" for variant \"" + variant + "\"");

    std::string error = mi_ntf::register_from_python(name, variant);
    if (!error.empty())
        throw std::runtime_error(error);

    const Properties *outer = std::exchange(in_progress, &props);
    try {
        ref<Object> object = PluginManager::instance()->create_object(props, variant, ObjectType::Unknown);
        in_progress = outer;
        return object;
    } catch (...) {
        in_progress = outer;
        throw;
    }
}

template <size_t... Variant>
void register_factories(std::string_view name, ObjectType type, PluginRegisterFn register_fn,
                        std::index_sequence<Variant...>) {
    (register_fn(name, variant_name(Variant), type, create<Variant>), ...);
}

/// One name serves several kinds of object in `nrf`; Unknown switches Mitsuba's check off.
ObjectType object_type(std::string_view name) {
    return name == "nrf" ? ObjectType::Unknown : ObjectType::Emitter;
}

} // namespace

/// Read as bytes by `mi-ntf doctor`: the C++ interface belongs to one Mitsuba version.
extern "C" __attribute__((visibility("default"), used))
const char mi_ntf_built_for[] = "mi_ntf bridge for mitsuba " MI_NTF_MITSUBA_VERSION;

extern "C" __attribute__((visibility("default")))
void init_plugin(std::string_view name, PluginRegisterFn register_fn) {
    {
        KeepProgramState keep;
        std::filesystem::path library = std::filesystem::absolute(util::library_path().string());
        mi_ntf::start_python(library.parent_path().parent_path());
    }
    register_factories(name, object_type(name), register_fn, std::make_index_sequence<variant_count()>());
}
