/* A host that loads a native FMU as a tool does: by its file, its functions and nothing else. FMI 2.0, or with -DFMI=3
   FMI 3.0.

   host LIBRARY RESOURCES GUID KIND run STEPS       prints time, inputs and outputs of a motion with reversals
   host LIBRARY RESOURCES GUID KIND random STEPS    random steps, nonsense among them: every value out must be a number
   host LIBRARY RESOURCES GUID KIND rollback STEPS  random states set back: what follows must be the same bits
   host LIBRARY RESOURCES GUID KIND save FILE       runs half a motion, writes the state, prints the other half
   host LIBRARY RESOURCES GUID KIND load FILE       reads that state in a new process and prints the other half
   host LIBRARY RESOURCES GUID KIND time STEPS      nanoseconds a step: set the inputs, step, get two outputs
   host LIBRARY RESOURCES GUID KIND open            instantiates and frees a hundred times, eight at once

   KIND is kinematic, compliant, inertia or rotor (compliant with the output's or the crank's inertia inside). The inputs come first in the value
   references: flange_a.phi, flange_a.w, then flange_b.tau, or flange_b.phi and flange_b.w (compliant). The outputs
   follow, up to max_contact_pressure, 9. Or KIND is compensator: desired_angle, desired_speed, load_torque, the outputs
   from 9 on, and the other inputs. */
#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#if FMI == 3
#include "fmi3FunctionTypes.h"
#define EACH(DO)                                                                                                       \
    DO(fmi3InstantiateCoSimulation) DO(fmi3FreeInstance) DO(fmi3EnterInitializationMode)                               \
    DO(fmi3ExitInitializationMode) DO(fmi3Terminate) DO(fmi3Reset) DO(fmi3GetFloat64) DO(fmi3SetFloat64)               \
    DO(fmi3DoStep) DO(fmi3GetFMUState) DO(fmi3SetFMUState) DO(fmi3FreeFMUState) DO(fmi3SerializedFMUStateSize)         \
    DO(fmi3SerializeFMUState) DO(fmi3DeserializeFMUState)
typedef fmi3Instance Instance;
typedef fmi3FMUState State;
typedef fmi3ValueReference Reference;
#else
#include "fmi2FunctionTypes.h"
#define EACH(DO)                                                                                                       \
    DO(fmi2Instantiate) DO(fmi2FreeInstance) DO(fmi2SetupExperiment) DO(fmi2EnterInitializationMode)                   \
    DO(fmi2ExitInitializationMode) DO(fmi2Terminate) DO(fmi2Reset) DO(fmi2GetReal) DO(fmi2SetReal) DO(fmi2DoStep)      \
    DO(fmi2GetFMUstate) DO(fmi2SetFMUstate) DO(fmi2FreeFMUstate) DO(fmi2SerializedFMUstateSize)                        \
    DO(fmi2SerializeFMUstate) DO(fmi2DeSerializeFMUstate)
typedef fmi2Component Instance;
typedef fmi2FMUstate State;
typedef fmi2ValueReference Reference;
#endif

#ifdef _WIN32
#include <windows.h>
static void *library;
static int load(const char *path) { return (library = (void *)LoadLibraryA(path)) != NULL; }
static void *found(const char *name) { return (void *)GetProcAddress((HMODULE)library, name); }
/* FMI's texts are UTF-8, a program's words are not. */
static const char *utf8(const char *word) {
    static char text[4 * MAX_PATH];
    wchar_t wide[MAX_PATH];
    MultiByteToWideChar(CP_ACP, 0, word, -1, wide, MAX_PATH);
    WideCharToMultiByte(CP_UTF8, 0, wide, -1, text, sizeof text, NULL, NULL);
    return text;
}
#else
#include <dlfcn.h>
static void *library;
static int load(const char *path) { return (library = dlopen(path, RTLD_NOW)) != NULL; }
static void *found(const char *name) { return dlsym(library, name); }
static const char *utf8(const char *word) { return word; }
#endif

#define IMPORT(NAME) static NAME##TYPE *NAME##_;
EACH(IMPORT)

enum { MOST_INPUTS = 8, REFERENCES = 10 };
static const Reference OF_DRIVE[REFERENCES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9};
static const Reference OF_COMPENSATOR[REFERENCES] = {0, 1, 2, 9, 10, 11, 12, 3, 4, 5};
static const Reference *references = OF_DRIVE;
static const double RATIO = -39.0;
static const char *resources, *guid;
static int inputs_count, inertia, rotor, messages;

static void fail(const char *what) {
    fprintf(stderr, "FAILED: %s\n", what);
    exit(1);
}

static void must(int status, const char *what) {
    if (status != 0) {
        fail(what);
    }
}

/* What differs between the versions; 0 is the good status of both. */
#if FMI == 3
static void logger(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category, fmi3String message) {
    (void)environment, (void)category;
    if (messages++ < 3) {
        fprintf(stderr, "status %d: %s\n", (int)status, message);
    }
}

static Instance instantiated(void) {
    return fmi3InstantiateCoSimulation_("drive", guid, resources, fmi3False, fmi3False, fmi3False, fmi3False, NULL, 0,
                                        NULL, logger, NULL);
}

static void started(Instance c) {
    must(fmi3EnterInitializationMode_(c, fmi3False, 0.0, 0.0, fmi3False, 0.0), "enter initialization");
    must(fmi3ExitInitializationMode_(c), "exit initialization");
}

static int put(Instance c, const double *values) {
    return (int)fmi3SetFloat64_(c, references, (size_t)inputs_count, values, (size_t)inputs_count);
}
static int get(Instance c, int first, int count, double *values) {
    return (int)fmi3GetFloat64_(c, references + first, (size_t)count, values, (size_t)count);
}
static int do_step(Instance c, double time, double size, int keep) {
    fmi3Boolean event, terminate, early;
    double reached;
    return (int)fmi3DoStep_(c, time, size, keep, &event, &terminate, &early, &reached);
}
static int reset(Instance c) { return (int)fmi3Reset_(c); }
static int terminated(Instance c) { return (int)fmi3Terminate_(c); }
static void freed(Instance c) { fmi3FreeInstance_(c); }
static int get_state(Instance c, State *state) { return (int)fmi3GetFMUState_(c, state); }
static int set_state(Instance c, State state) { return (int)fmi3SetFMUState_(c, state); }
static int free_state(Instance c, State *state) { return (int)fmi3FreeFMUState_(c, state); }
static int state_size(Instance c, State state, size_t *size) {
    return (int)fmi3SerializedFMUStateSize_(c, state, size);
}
static int serialize(Instance c, State state, char *bytes, size_t size) {
    return (int)fmi3SerializeFMUState_(c, state, (fmi3Byte *)bytes, size);
}
static int deserialize(Instance c, const char *bytes, size_t size, State *state) {
    return (int)fmi3DeserializeFMUState_(c, (const fmi3Byte *)bytes, size, state);
}
#else
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

static Instance instantiated(void) {
    return fmi2Instantiate_("drive", fmi2CoSimulation, guid, resources, &CALLBACKS, fmi2False, fmi2False);
}

static void started(Instance c) {
    must(fmi2SetupExperiment_(c, fmi2False, 0.0, 0.0, fmi2False, 0.0), "setup");
    must(fmi2EnterInitializationMode_(c), "enter initialization");
    must(fmi2ExitInitializationMode_(c), "exit initialization");
}

static int put(Instance c, const double *values) {
    return (int)fmi2SetReal_(c, references, (size_t)inputs_count, values);
}
static int get(Instance c, int first, int count, double *values) {
    return (int)fmi2GetReal_(c, references + first, (size_t)count, values);
}
static int do_step(Instance c, double time, double size, int keep) {
    return (int)fmi2DoStep_(c, time, size, keep ? fmi2True : fmi2False);
}
static int reset(Instance c) { return (int)fmi2Reset_(c); }
static int terminated(Instance c) { return (int)fmi2Terminate_(c); }
static void freed(Instance c) { fmi2FreeInstance_(c); }
static int get_state(Instance c, State *state) { return (int)fmi2GetFMUstate_(c, state); }
static int set_state(Instance c, State state) { return (int)fmi2SetFMUstate_(c, state); }
static int free_state(Instance c, State *state) { return (int)fmi2FreeFMUstate_(c, state); }
static int state_size(Instance c, State state, size_t *size) {
    return (int)fmi2SerializedFMUstateSize_(c, state, size);
}
static int serialize(Instance c, State state, char *bytes, size_t size) {
    return (int)fmi2SerializeFMUstate_(c, state, bytes, size);
}
static int deserialize(Instance c, const char *bytes, size_t size, State *state) {
    return (int)fmi2DeSerializeFMUstate_(c, bytes, size, state);
}
#endif

static Instance opened(void) {
    Instance c = instantiated();
    if (c == NULL) {
        fail("not instantiated");
    }
    return c;
}

static uint64_t seed = 88172645463325252u;

static double uniform(void) {
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return (double)(seed >> 11) / 9007199254740992.0;
}

/* Turns with reversals under a load that changes its sign and rests at zero. */
static void motion(int i, double *inputs) {
    double t = 1e-3 * i;
    inputs[0] = 3.0 * sin(2.0 * t) + 0.5 * t;
    inputs[1] = 6.0 * cos(2.0 * t) + 0.5;
    if (rotor) { /* an arm that swings by less than the drive follows */
        const double arm[MOST_INPUTS] = {0.02 * sin(5.0 * t), 1e-4 * sin(5.0 * t), 5e-4 * cos(5.0 * t), 2.0,
                                         20.0 * sin(7.0 * t), 140.0 * cos(7.0 * t), 0.01, 0.001};
        memcpy(inputs, arm, sizeof arm);
    } else if (inertia) { /* what stands at first is not thrown about */
        inputs[0] = 3.0 * (1.0 - cos(2.0 * t));
        inputs[1] = 6.0 * sin(2.0 * t);
        inputs[2] = 20.0 * sin(5.0 * t);
    } else if (inputs_count == 3) {
        inputs[2] = i / 250 % 3 == 2 ? 0.0 : 150.0 * sin(5.0 * t);
    } else {
        inputs[2] = inputs[0] / RATIO + 2e-4 * sin(5.0 * t);
        inputs[3] = inputs[1] / RATIO + 1e-3 * cos(5.0 * t);
    }
}

/* A place and a load, or a place of both flanges, that the drive can be at. */
static void anywhere(double *inputs) {
    inputs[0] = 40.0 * (uniform() - 0.5);
    inputs[1] = 400.0 * (uniform() - 0.5);
    if (rotor) {
        const double arm[MOST_INPUTS] = {0.1 * (uniform() - 0.5), 2e-4 * (uniform() - 0.5), 0.0, 0.5 + uniform(),
                                         40.0 * (uniform() - 0.5), 200.0 * (uniform() - 0.5), 0.01 * uniform(), 0.01};
        memcpy(inputs, arm, sizeof arm);
    } else if (inertia) { /* kicks that don't add up to a swing beyond the tables */
        inputs[0] = 1e-4 * (uniform() - 0.5);
        inputs[1] = 0.0;
        inputs[2] = 2.0 * (uniform() - 0.5);
    } else if (inputs_count == 3) {
        inputs[2] = uniform() < 0.2 ? 0.0 : 800.0 * (uniform() - 0.5);
    } else {
        inputs[2] = inputs[0] / RATIO + 4e-4 * (uniform() - 0.5);
        inputs[3] = inputs[1] / RATIO + 1e-2 * (uniform() - 0.5);
    }
}

static void step(Instance c, int i) {
    double inputs[MOST_INPUTS];
    motion(i, inputs);
    must(put(c, inputs), "set");
    must(do_step(c, 1e-3 * i, 1e-3, 1), "step");
}

static void print(Instance c, int i) {
    double values[REFERENCES];
    int k;
    motion(i, values);
    must(get(c, inputs_count, REFERENCES - inputs_count, values + inputs_count), "get");
    fprintf(stdout, "%.17g", 1e-3 * (i + 1));
    for (k = 0; k < REFERENCES; k++) {
        fprintf(stdout, ",%.17g", values[k]);
    }
    fprintf(stdout, "\n");
}

static void run(int steps) {
    Instance c = opened();
    int i;
    started(c);
    for (i = 0; i < steps; i++) {
        step(c, i);
        print(c, i);
    }
    must(terminated(c), "terminate");
    freed(c);
}

static double nonsense(double sane) {
    static const double VALUES[] = {NAN, INFINITY, -INFINITY, 1e9, -1e9, 0.0, 1e300, -1e300, 1e-300};
    double draw = uniform();
    return draw < 0.05 ? VALUES[(int)(uniform() * 9.0)] : sane;
}

static void random_steps(int steps) {
    Instance c = opened();
    double inputs[MOST_INPUTS], value;
    int i, k, refused = 0;
    started(c);
    for (i = 0; i < steps; i++) {
        anywhere(inputs);
        for (k = 0; k < inputs_count; k++) {
            inputs[k] = nonsense(inputs[k]);
        }
        if (put(c, inputs) != 0) {
            refused++;
        }
        if (do_step(c, nonsense(1e-3 * i), nonsense(uniform() < 0.1 ? -1e-3 : 1e-3), 1) != 0) {
            refused++;
        }
        for (k = 0; k < REFERENCES; k++) {
            value = 0.0;
            if (get(c, k, 1, &value) == 0 && !(fabs(value) < HUGE_VAL)) {
                fail("a value that is no number came out with a good status");
            }
        }
        if (i % 1000 == 999) {
            must(reset(c), "reset");
            started(c);
        }
    }
    fprintf(stdout, "%d steps, %d calls refused\n", steps, refused);
    freed(c);
}

static void record(Instance c, int steps, uint64_t from, double *values) {
    double inputs[MOST_INPUTS];
    int i;
    seed = from;
    for (i = 0; i < steps; i++) {
        anywhere(inputs);
        must(put(c, inputs), "set");
        must(do_step(c, 1e-3 * i, 1e-3, 0), "step");
        must(get(c, 0, REFERENCES, values + REFERENCES * i), "get");
    }
}

static void rollback(int steps) {
    enum { AHEAD = 20 };
    Instance c = opened();
    State kept = NULL;
    double first[REFERENCES * AHEAD], again[REFERENCES * AHEAD];
    int i;
    started(c);
    for (i = 0; i < steps; i++) {
        uint64_t from = seed;
        if (i % 20 == 19) {
            must(reset(c), "reset");
            started(c);
        }
        must(get_state(c, &kept), "get state");
        record(c, AHEAD, from, first);
        must(set_state(c, kept), "set state");
        record(c, AHEAD, from, again);
        if (memcmp(first, again, sizeof first) != 0) {
            fail("what follows a restored state is not the same bits");
        }
    }
    must(free_state(c, &kept), "free state");
    freed(c);
    fprintf(stdout, "%d states restored\n", steps);
}

static void half(int saving, const char *path) {
    Instance c = opened();
    State state = NULL;
    size_t size = 0;
    char *bytes;
    FILE *file = fopen(path, saving ? "wb" : "rb");
    int i;
    started(c);
    for (i = 0; saving && i < 400; i++) {
        step(c, i);
    }
    must(get_state(c, &state), "get state");
    must(state_size(c, state, &size), "size");
    bytes = malloc(size);
    if (file == NULL || bytes == NULL) {
        fail("file");
    }
    if (saving) {
        must(serialize(c, state, bytes, size), "serialize");
        fwrite(bytes, 1, size, file);
    } else {
        if (fread(bytes, 1, size, file) != size) {
            fail("a short file");
        }
        must(deserialize(c, bytes, size, &state), "deserialize");
        must(set_state(c, state), "set state");
        bytes[size / 2] ^= 1;
        if (deserialize(c, bytes, size, &state) == 0) {
            fail("a damaged state was taken");
        }
    }
    fclose(file);
    for (i = 400; i < 800; i++) {
        step(c, i);
        print(c, i);
    }
    free(bytes);
    must(free_state(c, &state), "free state");
    freed(c);
}

static void timed(int steps) {
    Instance c = opened();
    double inputs[MOST_INPUTS] = {0.0}, outputs[2], sum = 0.0;
    clock_t start;
    int i;
    started(c);
    start = clock();
    for (i = 0; i < steps; i++) {
        inputs[0] = 1e-3 * i;
        inputs[1] = 1.0;
        if (inputs_count == 3) {
            inputs[2] = i % 2000 - 1000 == 0 ? 1.0 : 0.1 * (i % 2000 - 1000);
        } else {
            inputs[2] = inputs[0] / RATIO + 1e-6 * (i % 2000 - 1000);
            inputs[3] = inputs[1] / RATIO;
        }
        put(c, inputs);
        do_step(c, 1e-3 * i, 1e-3, 1);
        get(c, inputs_count, 2, outputs);
        sum += outputs[0];
    }
    fprintf(stdout, "%.1f ns a step (%g)\n", 1e9 * (double)(clock() - start) / CLOCKS_PER_SEC / steps, sum);
    freed(c);
}

static void open_and_free(void) {
    Instance many[8];
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
            freed(many[(k + i) % 8]);
        }
    }
    fprintf(stdout, "100 times 8 instances\n");
}

int main(int count, char **words) {
    const char *what = count > 5 ? words[5] : "";
    int steps = count > 6 ? atoi(words[6]) : 0;
    if (count < 6) {
        fail("usage: host LIBRARY RESOURCES GUID KIND run|random|rollback|save|load|time|open ...");
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
    resources = utf8(words[2]);
    guid = words[3];
    inertia = strcmp(words[4], "inertia") == 0;
    rotor = strcmp(words[4], "rotor") == 0;
    references = strcmp(words[4], "compensator") == 0 ? OF_COMPENSATOR : OF_DRIVE;
    inputs_count = rotor ? MOST_INPUTS : strcmp(words[4], "compliant") == 0 ? 4 : 3;
    if (strcmp(what, "run") == 0) {
        run(steps);
    } else if (strcmp(what, "random") == 0) {
        random_steps(steps);
    } else if (strcmp(what, "rollback") == 0) {
        rollback(steps);
    } else if (strcmp(what, "save") == 0 || strcmp(what, "load") == 0) {
        half(what[0] == 's', words[6]);
    } else if (strcmp(what, "time") == 0) {
        timed(steps);
    } else if (strcmp(what, "open") == 0) {
        open_and_free();
    } else {
        fail("nothing asked for");
    }
    return 0;
}
