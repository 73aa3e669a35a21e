#include "uri.h"

#include <string.h>

/* The functions of <ctype.h> depend on the locale. */
static int letter(char c) {
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
}

static int hexadecimal(char c) {
    if (c >= '0' && c <= '9') {
        return c - '0';
    }
    if (c >= 'a' && c <= 'f') {
        return c - 'a' + 10;
    }
    return c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

int path_from_uri(const char *uri, char *path, size_t size) {
    const char *from = uri;
    size_t used = 0;
    int encoded = 0;
    if (uri == NULL || uri[0] == '\0') {
        return 1;
    }
    /* file:/path, file:///path, file://localhost/path and, for a share on Windows, file://server/path */
    if (strncmp(from, "file:", 5) == 0) {
        encoded = 1;
        from += 5;
        if (strncmp(from, "//", 2) == 0) {
            from += strncmp(from, "//localhost/", 12) == 0 ? 11 : from[2] == '/' ? 2 : 0;
        }
        if (from[0] == '/' && letter(from[1]) && (from[2] == ':' || from[2] == '|')) {
            from += 1;
        }
    } else if (strstr(uri, "://") != NULL) {
        return 1;
    }
    for (; *from != '\0' && !(encoded && (*from == '?' || *from == '#')); from++) {
        char next = *from;
        if (encoded && next == '%') {
            int high = hexadecimal(from[1]), low = high < 0 ? -1 : hexadecimal(from[2]);
            if (low < 0 || (high == 0 && low == 0)) {
                return 1;
            }
            next = (char)(16 * high + low);
            from += 2;
        }
        if (used + 1 >= size) {
            return 1;
        }
        path[used++] = next;
    }
    path[used] = '\0';
    return used == 0;
}
