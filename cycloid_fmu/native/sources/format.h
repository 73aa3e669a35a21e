#ifndef CYCLOID_FORMAT_H
#define CYCLOID_FORMAT_H

#include <stddef.h>

/* A message as the format that FMI 2.0's logger takes, cut at the size. Not "%s" and the message: hosts in Python see the
   format alone. */
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
