#include "python_host.h"
#include "without_frames.h"

#include <cstdio>
#include <cstdlib>
#include <dlfcn.h>
#include <fstream>
#include <iostream>
#include <iterator>
#include <stdexcept>
#include <unistd.h>
#include <vector>

namespace fs = std::filesystem;

namespace mi_ntf {

namespace {

using PyObject = void;

/// The few functions of CPython's stable interface that are needed here.
template <typename Function> Function python_function(const char *name) {
    auto function = reinterpret_cast<Function>(dlsym(RTLD_DEFAULT, name));
    if (!function)
        throw std::runtime_error(std::string("mi_ntf: libpython has no function ") + name);
    return function;
}

#define PYTHON(name, result, ...) python_function<result (*)(__VA_ARGS__)>(#name)

bool python_is_running() {
    auto check = reinterpret_cast<int (*)()>(dlsym(RTLD_DEFAULT, "Py_IsInitialized"));
    return check && check();
}

/// Marks, for all copies of this library, that Python is a guest of a C++ program here.
constexpr const char *guest_mark = "_mi_ntf_guest";

/// Holds the GIL for a scope.
struct Gil {
    int state = PYTHON(PyGILState_Ensure, int)();
    ~Gil() { PYTHON(PyGILState_Release, void, int)(state); }
};

/// Where an environment keeps its interpreter, found from its site-packages folder.
struct Environment {
    fs::path python;       ///< e.g. <venv>/bin/python3.11
    fs::path base_bin;     ///< folder of the interpreter that the environment was made from
    std::string version;   ///< e.g. "python3.11"
};

/// `home` of pyvenv.cfg, or an empty path.
fs::path venv_home(const fs::path &prefix) {
    std::ifstream file(prefix / "pyvenv.cfg");
    for (std::string line; std::getline(file, line);) {
        auto sep = line.find('=');
        if (sep == std::string::npos || line.compare(0, 4, "home") != 0)
            continue;
        auto begin = line.find_first_not_of(" \t", sep + 1);
        auto end = line.find_last_not_of(" \t\r");
        if (begin != std::string::npos)
            return line.substr(begin, end - begin + 1);
    }
    return {};
}

Environment find_environment(const fs::path &site_packages) {
    fs::path lib = site_packages.parent_path();             // <prefix>/lib/python3.11
    fs::path prefix = lib.parent_path().parent_path();
    Environment env;
    env.version = lib.filename().string();
    for (const fs::path &candidate : { prefix / "bin" / env.version, prefix / "bin" / "python3",
                                       fs::path("/usr/bin") / env.version }) {
        if (fs::exists(candidate)) {
            env.python = candidate;
            break;
        }
    }
    env.base_bin = venv_home(prefix);
    if (env.base_bin.empty())
        env.base_bin = env.python.parent_path();
    return env;
}

/// Make libpython's symbols global, as the extension modules expect. False if there is none.
bool load_libpython(const Environment &env) {
    std::string soname = "lib" + env.version + ".so.1.0";
    std::vector<std::string> names = { (env.base_bin.parent_path() / "lib" / soname).string() };
    // Only the system's own interpreter may use what the loader knows under this name:
    // another build of the same version brings another standard library.
    if (env.base_bin == "/usr/bin" || env.base_bin == "/bin")
        names.push_back(soname);
    for (const std::string &name : names)
        if (dlopen(name.c_str(), RTLD_NOW | RTLD_GLOBAL))
            return true;
    return false;
}

/// Continue as the look-alike program of `mi-ntf render`; returns only on failure.
void become_launcher(const Environment &env) {
    std::ifstream file("/proc/self/cmdline", std::ios::binary);
    std::string text((std::istreambuf_iterator<char>(file)), {});
    std::vector<std::string> words = { env.python.string(), "-m", "mi_ntf", "render" };
    size_t begin = text.find('\0') + 1;                      // skip the program's name
    for (size_t end; (end = text.find('\0', begin)) != std::string::npos; begin = end + 1)
        words.push_back(text.substr(begin, end - begin));
    std::vector<char *> argv;
    for (std::string &word : words)
        argv.push_back(word.data());
    argv.push_back(nullptr);
    std::cout.flush();
    std::fflush(nullptr);
    execv(argv[0], argv.data());
}

/**
 * Leave at once when the program ends. Destructors of extension modules would run without
 * the GIL and abort, and Py_FinalizeEx waits for threads that are gone; by now the image is
 * on disk and only buffered text is left to write.
 *
 * Exit handlers and destructors of loaded libraries run in one order, last registered first:
 * this one is registered again after each step that may have loaded a library.
 *
 * The program returns -1 on errors, which a shell sees as 255; here they end with 1 as in `mi-ntf`.
 */
void leave(int status, void *) {
    PYTHON(PyGILState_Ensure, int)();
    PYTHON(PyRun_SimpleStringFlags, int, const char *, void *)
        ("import sys; sys.stdout.flush(); sys.stderr.flush()", nullptr);
    std::cout.flush();
    std::fflush(nullptr);
    _exit(status < 0 ? 1 : status);
}

} // namespace

void start_python(const fs::path &site_packages) {
    if (python_is_running())
        return;

    const char *debug = std::getenv("MI_NTF_DEBUG");
    if (!debug || std::string(debug) != "1")
        new WithoutFrames(std::cerr);                        // for as long as the program runs

    Environment env = find_environment(site_packages);
    if (env.python.empty())
        throw std::runtime_error("mi_ntf: found no Python that belongs to " + site_packages.string() +
                                 "; use `mi-ntf render` in place of `mitsuba`");
    if (!load_libpython(env)) {
        become_launcher(env);
        throw std::runtime_error("mi_ntf: " + env.python.string() + " has no shared library lib" + env.version +
                                 ".so.1.0 and cannot be run; `mi-ntf doctor` names the remedy");
    }

    // Mitsuba takes the names of files as UTF-8, whatever the locale; in the locale C (LC_ALL=C, or one
    // that is not installed) Python would not find those that are not ASCII.
    if (auto utf8_mode = static_cast<int *>(dlsym(RTLD_DEFAULT, "Py_UTF8Mode")))
        *utf8_mode = 1;

    // The program name leads Python to pyvenv.cfg and so to the environment's packages.
    wchar_t *name = PYTHON(Py_DecodeLocale, wchar_t *, const char *, size_t *)(env.python.c_str(), nullptr);
    PYTHON(Py_SetProgramName, void, const wchar_t *)(name);
    PYTHON(Py_InitializeEx, void, int)(0);                   // 0: Ctrl-C keeps ending the program

    PYTHON(PyRun_SimpleStringFlags, int, const char *, void *)
        ((std::string("import sys; sys.") + guest_mark + " = True").c_str(), nullptr);
    bool imported = PYTHON(PyImport_ImportModule, PyObject *, const char *)("mi_ntf.bridge") != nullptr;
    if (!imported)
        PYTHON(PyErr_Print, void)();                         // message and traceback go to stderr
    PYTHON(PyEval_SaveThread, void *)();                     // other threads may use Python now
    on_exit(leave, nullptr);
    if (!imported)
        throw std::runtime_error("mi_ntf: Python could not import mi_ntf (see above); run `mi-ntf doctor`");
}

std::string register_from_python(const std::string &name, const std::string &variant) {
    Gil gil;
    auto module = PYTHON(PyImport_ImportModule, PyObject *, const char *)("mi_ntf.bridge");
    PyObject *text = nullptr;
    if (module) {
        auto call = python_function<PyObject *(*)(PyObject *, const char *, const char *, ...)>("PyObject_CallMethod");
        text = call(module, "serve", "sss", name.c_str(), variant.c_str(),
                    "mitsuba " MI_NTF_MITSUBA_VERSION);
    }
    const char *utf8 = text ? PYTHON(PyUnicode_AsUTF8, const char *, PyObject *)(text) : nullptr;
    if (!utf8) {
        PYTHON(PyErr_Print, void)();
        return "mi_ntf.bridge failed (see above)";
    }
    if (PYTHON(PySys_GetObject, PyObject *, const char *)(guest_mark))
        on_exit(leave, nullptr);
    std::string result = utf8;
    PYTHON(Py_DecRef, void, PyObject *)(text);
    PYTHON(Py_DecRef, void, PyObject *)(module);
    return result;
}

} // namespace mi_ntf
