/* What C99 calls otherwise than Windows' own C runtime does. With these few the library needs nothing of mingw's, which
   takes minutes to compile. */
#include <stdarg.h>
#include <stddef.h>

typedef unsigned long long options;
enum { STANDARD_SNPRINTF = 2 };

__declspec(dllimport) int __stdio_common_vsprintf(options, char *, size_t, const char *, void *, va_list);
__declspec(dllimport) int __stdio_common_vsscanf(options, const char *, size_t, const char *, void *, va_list);

int vsnprintf(char *text, size_t size, const char *format, va_list arguments) {
    return __stdio_common_vsprintf(STANDARD_SNPRINTF, text, size, format, NULL, arguments);
}

int snprintf(char *text, size_t size, const char *format, ...) {
    va_list arguments;
    int length;
    va_start(arguments, format);
    length = vsnprintf(text, size, format, arguments);
    va_end(arguments);
    return length;
}

int sscanf(const char *text, const char *format, ...) {
    va_list arguments;
    int found;
    va_start(arguments, format);
    found = __stdio_common_vsscanf(0, text, (size_t)-1, format, NULL, arguments);
    va_end(arguments);
    return found;
}
