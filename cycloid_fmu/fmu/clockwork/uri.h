#ifndef CYCLOID_URI_H
#define CYCLOID_URI_H

#include <stddef.h>

/* Convert a path or file URI to a path; returns 1 if it is neither, empty, or longer than the size. */
int path_from_uri(const char *uri, char *path, size_t size);

#endif
