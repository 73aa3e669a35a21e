#ifndef CYCLOID_FORMAT_H
#define CYCLOID_FORMAT_H

#include <stddef.h>

/* A message as a format string for FMI 2.0's logger, truncated at the size. It is not an argument of "%s", because hosts
   in Python receive only the format. */
static void format_of(const char *message, char *format, size_t size) {
    size_t used = 0;
    for (; *message != '\0' && used + 3 <= size; message++) {
        if (*message == '%') {
            format[used++] = '%';
        }
        format[used++] = *message;
    }
    format[used] = '\0';
}

#endif
