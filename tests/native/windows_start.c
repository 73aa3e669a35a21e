/* The C host's start and its output on Windows, as `fmu/libraries/ucrt.c` does it: without mingw's library. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

__declspec(dllimport) int _configure_narrow_argv(int);
__declspec(dllimport) int *__p___argc(void);
__declspec(dllimport) char ***__p___argv(void);

int main(int, char **);
void __main(void) {} /* mingw's compiler calls it from main */

void start(void) {
    _configure_narrow_argv(1);
    exit(main(*__p___argc(), *__p___argv()));
}

int fprintf(FILE *file, const char *format, ...) {
    va_list arguments;
    int length;
    va_start(arguments, format);
    length = __stdio_common_vfprintf(0, file, format, NULL, arguments);
    va_end(arguments);
    return length;
}
