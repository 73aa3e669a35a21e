/* A host that loads a native FMU as a tool does: by its file, its functions and nothing else. FMI 2.0.

   host LIBRARY RESOURCES-URI GUID run STEPS       prints time, inputs and outputs of a motion with reversals
   host LIBRARY RESOURCES-URI GUID random STEPS    random steps, nonsense among them: every value out must be a number
   host LIBRARY RESOURCES-URI GUID rollback STEPS  random states set back: what follows must be the same bits
   host LIBRARY RESOURCES-URI GUID save FILE       runs half a motion, writes the state, prints the other half
   host LIBRARY RESOURCES-URI GUID load FILE       reads that state in a new process and prints the other half
   host LIBRARY RESOURCES-URI GUID time STEPS      nanoseconds a step: set three inputs, step, get two outputs
   host LIBRARY RESOURCES-URI GUID open            instantiates and frees a hundred times, eight at once

   Value references 0, 1, 2 are flange_a.phi, flange_a.w and flange_b.tau; 3 and 4 flange_b.phi and flange_b.w. */
#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "fmi2FunctionTypes.h"

#ifdef _WIN32
#include <windows.h>
static void *library;
static int load(const char *path) { return (library = (void *)LoadLibraryA(path)) != NULL; }
static void *found(const char *name) { return (void *)GetProcAddress((HMODULE)library, name); }
#else
#include <dlfcn.h>
static void *library;
static int load(const char *path) { return (library = dlopen(path, RTLD_NOW)) != NULL; }
static void *found(const char *name) { return dlsym(library, name); }
#endif

#define IMPORT(NAME) static NAME##TYPE *NAME##_;
#define EACH(DO)                                                                                                       \
    DO(fmi2Instantiate) DO(fmi2FreeInstance) DO(fmi2SetupExperiment) DO(fmi2EnterInitializationMode)                   \
    DO(fmi2ExitInitializationMode) DO(fmi2Terminate) DO(fmi2Reset) DO(fmi2GetReal) DO(fmi2SetReal) DO(fmi2DoStep)      \
    DO(fmi2GetFMUstate) DO(fmi2SetFMUstate) DO(fmi2FreeFMUstate) DO(fmi2SerializedFMUstateSize)                        \
    DO(fmi2SerializeFMUstate) DO(fmi2DeSerializeFMUstate)
EACH(IMPORT)

static const char *uri, *guid;
static const fmi2ValueReference INPUTS[3] = {0, 1, 2}, OUTPUTS[8] = {3, 4, 5, 6, 7, 8, 9, 2};
static int messages;

static void logger(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status, fmi2String category,
                   fmi2String message, ...) {
    char text[1024];
    va_list arguments;
    (void)environment, (void)name, (void)category;
    va_start(arguments, message);
    vsnprintf(text, sizeof text, message, arguments);
    va_end(arguments);
    if (messages++ < 3) {
        fprintf(stderr, "status %d: %s\n", (int)status, text);
    }
}

static const fmi2CallbackFunctions CALLBACKS = {logger, calloc, free, NULL, NULL};

static void fail(const char *what) {
    fprintf(stderr, "FAILED: %s\n", what);
    exit(1);
}

static void must(fmi2Status status, const char *what) {
    if (status != fmi2OK) {
        fail(what);
    }
}

static fmi2Component opened(void) {
    fmi2Component c = fmi2Instantiate_("drive", fmi2CoSimulation, guid, uri, &CALLBACKS, fmi2False, fmi2False);
    if (c == NULL) {
        fail("not instantiated");
    }
    return c;
}

static void started(fmi2Component c) {
    must(fmi2SetupExperiment_(c, fmi2False, 0.0, 0.0, fmi2False, 0.0), "setup");
    must(fmi2EnterInitializationMode_(c), "enter initialization");
    must(fmi2ExitInitializationMode_(c), "exit initialization");
}

static uint64_t seed = 88172645463325252u;

static double uniform(void) {
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return (double)(seed >> 11) / 9007199254740992.0;
}

/* Turns with reversals under a load that changes its sign and rests at zero. */
static void motion(int i, double inputs[3]) {
    double t = 1e-3 * i;
    inputs[0] = 3.0 * sin(2.0 * t) + 0.5 * t;
    inputs[1] = 6.0 * cos(2.0 * t) + 0.5;
    inputs[2] = i / 250 % 3 == 2 ? 0.0 : 150.0 * sin(5.0 * t);
}

static void step(fmi2Component c, int i) {
    double inputs[3];
    motion(i, inputs);
    must(fmi2SetReal_(c, INPUTS, 3, inputs), "set");
    must(fmi2DoStep_(c, 1e-3 * i, 1e-3, fmi2True), "step");
}

static void print(fmi2Component c, int i) {
    double inputs[3], outputs[7];
    int k;
    motion(i, inputs);
    must(fmi2GetReal_(c, OUTPUTS, 7, outputs), "get");
    printf("%.17g,%.17g,%.17g,%.17g", 1e-3 * (i + 1), inputs[0], inputs[1], inputs[2]);
    for (k = 0; k < 7; k++) {
        printf(",%.17g", outputs[k]);
    }
    printf("\n");
}

static void run(int steps) {
    fmi2Component c = opened();
    int i;
    started(c);
    for (i = 0; i < steps; i++) {
        step(c, i);
        print(c, i);
    }
    must(fmi2Terminate_(c), "terminate");
    fmi2FreeInstance_(c);
}

static double nonsense(double sane) {
    static const double VALUES[] = {NAN, INFINITY, -INFINITY, 1e9, -1e9, 0.0, 1e300, -1e300, 1e-300};
    double draw = uniform();
    return draw < 0.05 ? VALUES[(int)(uniform() * 9.0)] : sane;
}

static void random_steps(int steps) {
    fmi2Component c = opened();
    double inputs[3], outputs[8];
    int i, k, refused = 0;
    started(c);
    for (i = 0; i < steps; i++) {
        inputs[0] = nonsense(40.0 * (uniform() - 0.5));
        inputs[1] = nonsense(400.0 * (uniform() - 0.5));
        inputs[2] = nonsense(uniform() < 0.2 ? 0.0 : 800.0 * (uniform() - 0.5));
        if (fmi2SetReal_(c, INPUTS, 3, inputs) != fmi2OK) {
            refused++;
        }
        if (fmi2DoStep_(c, nonsense(1e-3 * i), nonsense(uniform() < 0.1 ? -1e-3 : 1e-3), fmi2True) != fmi2OK) {
            refused++;
        }
        for (k = 0; k < 8; k++) {
            outputs[k] = 0.0;
            if (fmi2GetReal_(c, &OUTPUTS[k], 1, &outputs[k]) == fmi2OK && !(fabs(outputs[k]) < HUGE_VAL)) {
                fail("a value that is no number came out with a good status");
            }
        }
        if (i % 1000 == 999) {
            must(fmi2Reset_(c), "reset");
            started(c);
        }
    }
    printf("%d steps, %d calls refused\n", steps, refused);
    fmi2FreeInstance_(c);
}

static void record(fmi2Component c, int steps, uint64_t from, double *outputs) {
    double inputs[3];
    int i;
    seed = from;
    for (i = 0; i < steps; i++) {
        inputs[0] = 20.0 * (uniform() - 0.5);
        inputs[1] = 100.0 * (uniform() - 0.5);
        inputs[2] = uniform() < 0.3 ? 0.0 : 400.0 * (uniform() - 0.5);
        must(fmi2SetReal_(c, INPUTS, 3, inputs), "set");
        must(fmi2DoStep_(c, 1e-3 * i, 1e-3, fmi2False), "step");
        must(fmi2GetReal_(c, OUTPUTS, 7, outputs + 7 * i), "get");
    }
}

static void rollback(int steps) {
    enum { AHEAD = 20 };
    fmi2Component c = opened();
    fmi2FMUstate kept = NULL;
    double first[7 * AHEAD], again[7 * AHEAD];
    int i;
    started(c);
    for (i = 0; i < steps; i++) {
        uint64_t from = seed;
        must(fmi2GetFMUstate_(c, &kept), "get state");
        record(c, AHEAD, from, first);
        must(fmi2SetFMUstate_(c, kept), "set state");
        record(c, AHEAD, from, again);
        if (memcmp(first, again, sizeof first) != 0) {
            fail("what follows a restored state is not the same bits");
        }
    }
    must(fmi2FreeFMUstate_(c, &kept), "free state");
    fmi2FreeInstance_(c);
    printf("%d states restored\n", steps);
}

static void half(int saving, const char *path) {
    fmi2Component c = opened();
    fmi2FMUstate state = NULL;
    size_t size = 0;
    char *bytes;
    FILE *file = fopen(path, saving ? "wb" : "rb");
    int i;
    started(c);
    for (i = 0; saving && i < 400; i++) {
        step(c, i);
    }
    must(fmi2GetFMUstate_(c, &state), "get state");
    must(fmi2SerializedFMUstateSize_(c, state, &size), "size");
    bytes = malloc(size);
    if (file == NULL || bytes == NULL) {
        fail("file");
    }
    if (saving) {
        must(fmi2SerializeFMUstate_(c, state, bytes, size), "serialize");
        fwrite(bytes, 1, size, file);
    } else {
        if (fread(bytes, 1, size, file) != size) {
            fail("a short file");
        }
        must(fmi2DeSerializeFMUstate_(c, bytes, size, &state), "deserialize");
        must(fmi2SetFMUstate_(c, state), "set state");
        bytes[size / 2] ^= 1;
        if (fmi2DeSerializeFMUstate_(c, bytes, size, &state) == fmi2OK) {
            fail("a damaged state was taken");
        }
    }
    fclose(file);
    for (i = 400; i < 800; i++) {
        step(c, i);
        print(c, i);
    }
    free(bytes);
    must(fmi2FreeFMUstate_(c, &state), "free state");
    fmi2FreeInstance_(c);
}

static void timed(int steps) {
    fmi2Component c = opened();
    double inputs[3], outputs[2], sum = 0.0;
    clock_t start;
    int i;
    started(c);
    start = clock();
    for (i = 0; i < steps; i++) {
        inputs[0] = 1e-3 * i;
        inputs[1] = 1.0;
        inputs[2] = i % 2000 - 1000 == 0 ? 1.0 : 0.1 * (i % 2000 - 1000);
        fmi2SetReal_(c, INPUTS, 3, inputs);
        fmi2DoStep_(c, 1e-3 * i, 1e-3, fmi2True);
        fmi2GetReal_(c, OUTPUTS, 2, outputs);
        sum += outputs[0];
    }
    printf("%.1f ns a step (%g)\n", 1e9 * (double)(clock() - start) / CLOCKS_PER_SEC / steps, sum);
    fmi2FreeInstance_(c);
}

static void open_and_free(void) {
    fmi2Component many[8];
    int i, k;
    for (i = 0; i < 100; i++) {
        for (k = 0; k < 8; k++) {
            many[k] = opened();
        }
        for (k = 0; k < 8; k++) {
            started(many[k]);
            step(many[k], k);
        }
        for (k = 0; k < 8; k++) {
            fmi2FreeInstance_(many[(k + i) % 8]);
        }
    }
    printf("100 times 8 instances\n");
}

int main(int count, char **words) {
    const char *what = count > 4 ? words[4] : "";
    int steps = count > 5 ? atoi(words[5]) : 0;
    if (count < 5) {
        fail("usage: host LIBRARY RESOURCES-URI GUID run|random|rollback|save|load|time|open ...");
    }
    if (!load(words[1])) {
        fail("the library can't be loaded");
    }
#define FIND(NAME)                                                                                                     \
    NAME##_ = (NAME##TYPE *)found(#NAME);                                                                              \
    if (NAME##_ == NULL) {                                                                                             \
        fail(#NAME " is missing");                                                                                     \
    }
    EACH(FIND)
    uri = words[2];
    guid = words[3];
    if (strcmp(what, "run") == 0) {
        run(steps);
    } else if (strcmp(what, "random") == 0) {
        random_steps(steps);
    } else if (strcmp(what, "rollback") == 0) {
        rollback(steps);
    } else if (strcmp(what, "save") == 0 || strcmp(what, "load") == 0) {
        half(what[0] == 's', words[5]);
    } else if (strcmp(what, "time") == 0) {
        timed(steps);
    } else if (strcmp(what, "open") == 0) {
        open_and_free();
    } else {
        fail("nothing asked for");
    }
    return 0;
}
