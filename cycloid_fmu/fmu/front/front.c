/* The library that hosts load from an FMI 2.0 FMU in Python. It wraps pythonfmu's library in the same folder, which treats
   the resources' URI as a path and fails if characters are percent-encoded. This wrapper converts the URI to a path, turns
   a discarded step into an error and a fatal status, as of a wrong value reference, into one, and logs refusals even if the host has not asked for logging, as a native FMU does; all
   other calls are forwarded unchanged. It is compiled in advance with `python tests/native/libraries.py`, because an FMU in
   Python is built without a compiler. */
#ifdef _WIN32
#include <windows.h>
#else
#define _GNU_SOURCE
#include <dlfcn.h>
#include <limits.h>
#include <link.h>
#include <pthread.h>
#endif

#include <string.h>

#include "fmi2Functions.h"
#include "format.h"
#include "uri.h"

/* Hash of the source, so that a test can check that the library was compiled from it. */
FMI2_Export const char front_source[] = SOURCE_HASH;

#define FORWARDED(X)                                                                                                   \
    X(SetupExperiment,                                                                                                 \
      (fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance, fmi2Real start, fmi2Boolean stop_defined,   \
       fmi2Real stop),                                                                                                 \
      (c, tolerance_defined, tolerance, start, stop_defined, stop))                                                    \
    X(EnterInitializationMode, (fmi2Component c), (c))                                                                 \
    X(ExitInitializationMode, (fmi2Component c), (c))                                                                  \
    X(Terminate, (fmi2Component c), (c))                                                                               \
    X(GetReal, (fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real v[]), (c, r, n, v))                  \
    X(GetInteger, (fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Integer v[]), (c, r, n, v))            \
    X(GetBoolean, (fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Boolean v[]), (c, r, n, v))            \
    X(GetString, (fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2String v[]), (c, r, n, v))              \
    X(SetReal, (fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Real v[]), (c, r, n, v))            \
    X(SetInteger, (fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Integer v[]), (c, r, n, v))      \
    X(SetBoolean, (fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Boolean v[]), (c, r, n, v))      \
    X(SetString, (fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2String v[]), (c, r, n, v))        \
    X(GetFMUstate, (fmi2Component c, fmi2FMUstate *state), (c, state))                                                 \
    X(SetFMUstate, (fmi2Component c, fmi2FMUstate state), (c, state))                                                  \
    X(FreeFMUstate, (fmi2Component c, fmi2FMUstate *state), (c, state))                                                \
    X(SerializedFMUstateSize, (fmi2Component c, fmi2FMUstate state, size_t *size), (c, state, size))                   \
    X(SerializeFMUstate, (fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t n), (c, state, bytes, n))      \
    X(DeSerializeFMUstate, (fmi2Component c, const fmi2Byte bytes[], size_t n, fmi2FMUstate *state),                   \
      (c, bytes, n, state))                                                                                            \
    X(GetDirectionalDerivative,                                                                                        \
      (fmi2Component c, const fmi2ValueReference of[], size_t n_of, const fmi2ValueReference by[], size_t n_by,        \
       const fmi2Real change[], fmi2Real v[]),                                                                         \
      (c, of, n_of, by, n_by, change, v))                                                                              \
    X(SetRealInputDerivatives,                                                                                         \
      (fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Integer orders[], const fmi2Real v[]),       \
      (c, r, n, orders, v))                                                                                            \
    X(GetRealOutputDerivatives,                                                                                        \
      (fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Integer orders[], fmi2Real v[]),             \
      (c, r, n, orders, v))                                                                                            \
    X(CancelStep, (fmi2Component c), (c))                                                                              \
    X(GetStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Status *v), (c, kind, v))                            \
    X(GetRealStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Real *v), (c, kind, v))                          \
    X(GetIntegerStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Integer *v), (c, kind, v))                    \
    X(GetBooleanStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *v), (c, kind, v))                    \
    X(GetStringStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2String *v), (c, kind, v))
#define FUNCTIONS(X)                                                                                                   \
    FORWARDED(X)                                                                                                       \
    X(Reset, (fmi2Component c), (c))                                                                                   \
    X(DoStep, (fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_state), (c, time, step, no_state))

#ifdef _WIN32
enum { PATH_SIZE = 512 }; /* Windows has 260; no function may need a page of stack, as no stack probe is linked */
#else
enum { PATH_SIZE = PATH_MAX };
#endif

/* The wrapped functions: loaded for the first instance, released with the last. This unloads the library only on Windows;
   on Linux the slave itself keeps it loaded. */
static struct {
    void *library;
    size_t instances;
    fmi2InstantiateTYPE *Instantiate;
    fmi2FreeInstanceTYPE *FreeInstance;
#define X(NAME, PARAMETERS, ARGUMENTS) fmi2##NAME##TYPE *NAME;
    FUNCTIONS(X)
#undef X
} behind;

/* `open_library` returns why the wrapped library can't be loaded, `make_ascii` why pythonfmu can't read a path, or NULL. */
#ifdef _WIN32
static SRWLOCK busy = SRWLOCK_INIT;

static void lock(void) {
    AcquireSRWLockExclusive(&busy);
}

static void unlock(void) {
    ReleaseSRWLockExclusive(&busy);
}

static const char *open_library(void) {
    static const wchar_t NAME[] = L"pythonfmu-export.dll";
    wchar_t path[PATH_SIZE];
    HMODULE module;
    DWORD used;
    if (!GetModuleHandleExW(GET_MODULE_HANDLE_EX_FLAG_FROM_ADDRESS | GET_MODULE_HANDLE_EX_FLAG_UNCHANGED_REFCOUNT,
                            (LPCWSTR)&behind, &module)) {
        return "the FMU's library can't find its own path";
    }
    used = GetModuleFileNameW(module, path, PATH_SIZE);
    if (used == 0 || used >= PATH_SIZE) {
        return "the path of the FMU's library is too long";
    }
    while (used > 0 && path[used - 1] != L'\\') {
        used--;
    }
    if (used + sizeof NAME / sizeof *NAME > PATH_SIZE) {
        return "the path of the FMU's library is too long";
    }
    memcpy(path + used, NAME, sizeof NAME);
    /* First with the search order of Python's ctypes, which finds Python's own library if it is not yet loaded. */
    module = LoadLibraryExW(path, NULL, LOAD_LIBRARY_SEARCH_DEFAULT_DIRS | LOAD_LIBRARY_SEARCH_DLL_LOAD_DIR);
    if (module == NULL) {
        module = LoadLibraryExW(path, NULL, LOAD_WITH_ALTERED_SEARCH_PATH);
    }
    if (module == NULL) {
        return "pythonfmu-export.dll next to the FMU's library can't be loaded: is Python (python3.dll) on the PATH?";
    }
    behind.library = module;
    return NULL;
}

static void *symbol(const char *name) {
    return (void *)GetProcAddress(behind.library, name);
}

static void close_library(void) {
    FreeLibrary(behind.library);
}

static int is_ascii(const wchar_t *path) {
    while (*path != 0 && *path <= 126) {
        path++;
    }
    return *path == 0;
}

/* pythonfmu reads the path both as UTF-8 and in the system's code page: only ASCII is the same in both. A path with
   other characters has a short name in ASCII, unless the volume stores none. */
static const char *make_ascii(char *path) {
    wchar_t wide[PATH_SIZE];
    DWORD i, used;
    if (GetACP() == CP_UTF8) {
        return NULL;
    }
    if (MultiByteToWideChar(CP_UTF8, MB_ERR_INVALID_CHARS, path, -1, wide, PATH_SIZE) == 0) {
        return "the resources' location is not UTF-8, or too long";
    }
    if (is_ascii(wide)) {
        return NULL;
    }
    used = GetShortPathNameW(wide, wide, PATH_SIZE);
    if (used == 0 || used >= PATH_SIZE || !is_ascii(wide)) {
        return "the FMU's path has characters beyond ASCII, on a volume without short names: move it";
    }
    for (i = 0; i <= used; i++) {
        path[i] = (char)wide[i];
    }
    return NULL;
}
#else
static pthread_mutex_t busy = PTHREAD_MUTEX_INITIALIZER;

static void lock(void) {
    pthread_mutex_lock(&busy);
}

static void unlock(void) {
    pthread_mutex_unlock(&busy);
}

static const char *open_library(void) {
    static const char NAME[] = "/pythonfmu-export.so";
    char path[PATH_MAX + sizeof NAME];
    struct link_map *self;
    Dl_info told;
    /* Not $ORIGIN in the path: glibc would confuse it with another FMU's library, whose path is then the same. */
    if (!dladdr1(&behind, &told, (void **)&self, RTLD_DL_LINKMAP) || dlinfo(self, RTLD_DI_ORIGIN, path)) {
        return "the FMU's library can't find its own path";
    }
    strcat(path, NAME);
    behind.library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    return behind.library == NULL ? dlerror() : NULL;
}

static void *symbol(const char *name) {
    return dlsym(behind.library, name);
}

static void close_library(void) {
    dlclose(behind.library);
}

static const char *make_ascii(char *path) {
    (void)path;
    return NULL;
}
#endif

/* Returns which function is missing, or NULL. */
static const char *find_functions(void) {
    void *function;
#define X(NAME, PARAMETERS, ARGUMENTS)                                                                                 \
    function = symbol("fmi2" #NAME);                                                                                   \
    if (function == NULL) {                                                                                            \
        return "the library next to the FMU's is not pythonfmu's: it has no fmi2" #NAME;                               \
    }                                                                                                                  \
    memcpy(&behind.NAME, &function, sizeof function);
    FUNCTIONS(X) X(FreeInstance, , ) X(Instantiate, , )
#undef X
    return NULL;
}

static const char *enter(void) {
    const char *problem = NULL;
    lock();
    if (behind.instances == 0) {
        problem = open_library();
        if (problem == NULL && (problem = find_functions()) != NULL) {
            close_library();
        }
    }
    behind.instances += problem == NULL;
    unlock();
    return problem;
}

static void leave(void) {
    lock();
    if (--behind.instances == 0) {
        close_library();
    }
    unlock();
}

const char *fmi2GetTypesPlatform(void) {
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void) {
    return fmi2Version;
}

static void log_problem(const fmi2CallbackFunctions *functions, fmi2String name, const char *message) {
    char format[1024];
    if (functions == NULL || functions->logger == NULL) {
        return;
    }
    format_of(message, format, sizeof format);
    functions->logger(functions->componentEnvironment, name, fmi2Error, "logStatusError", format);
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    char path[PATH_SIZE];
    fmi2Component made;
    const char *problem = path_from_uri(resources, path, sizeof path)
                              ? "the resources' location is neither a path nor a file URI, or too long"
                              : make_ascii(path);
    if (problem == NULL) {
        problem = enter();
    }
    if (problem != NULL) {
        log_problem(functions, name, problem);
        return NULL;
    }
    (void)logging;
    made = behind.Instantiate(name, type, guid, path, functions, visible, fmi2True);
    if (made == NULL) {
        leave();
    }
    return made;
}

void fmi2FreeInstance(fmi2Component c) {
    if (c != NULL) {
        behind.FreeInstance(c);
        leave();
    }
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    (void)c, (void)on, (void)n, (void)categories; /* refusals are always logged, and nothing else is */
    return fmi2OK;
}

/* pythonfmu calls every exception fatal, but the slave survives it (kept_alive in slave.py). */
static fmi2Status survived(fmi2Status status) {
    return status == fmi2Fatal ? fmi2Error : status;
}

/* A shorter step would be refused too: after a discarded one, importers end without a message, or never. */
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_state) {
    fmi2Status status = behind.DoStep(c, time, step, no_state);
    return status == fmi2Discard ? fmi2Error : survived(status);
}

/* It makes a new slave, so that none is left if this fails. */
fmi2Status fmi2Reset(fmi2Component c) {
    return behind.Reset(c);
}

#define X(NAME, PARAMETERS, ARGUMENTS)                                                                                 \
    fmi2Status fmi2##NAME PARAMETERS {                                                                                 \
        return survived(behind.NAME ARGUMENTS);                                                                        \
    }
FORWARDED(X)
