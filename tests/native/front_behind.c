/* A library to stand behind the front in pythonfmu's place, which keeps what reaches it. Any call's arguments are so many
   integers and reals: System V's calling convention hands both on in registers of their own. */
#include <stddef.h>
#include <string.h>

char last[64], location[4096];
size_t integers[7];
double reals[3];
int answer = 2; /* fmi2Discard */

static int keep(const char *name, const size_t *whole, const double *real) {
    memcpy(last, name, strlen(name) + 1);
    memcpy(integers, whole, sizeof integers);
    memcpy(reals, real, sizeof reals);
    return answer;
}

#define CALL(NAME)                                                                                                     \
    int NAME(size_t a, size_t b, size_t c, size_t d, size_t e, size_t f, double x, double y, double z, size_t g) {     \
        size_t whole[] = {a, b, c, d, e, f, g};                                                                        \
        double real[] = {x, y, z};                                                                                     \
        return keep(#NAME, whole, real);                                                                               \
    }
CALLS

void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources, const void *functions,
                      int visible, int logging) {
    size_t whole[] = {(size_t)name, (size_t)type, (size_t)guid, 0, (size_t)functions, (size_t)visible, (size_t)logging};
    strcpy(location, resources);
    keep("fmi2Instantiate", whole, reals);
    return strcmp(guid, "foreign") == 0 ? NULL : last;
}

void fmi2FreeInstance(void *c) {
    size_t whole[7] = {(size_t)c};
    keep("fmi2FreeInstance", whole, reals);
}
