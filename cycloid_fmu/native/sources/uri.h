#ifndef CYCLOID_URI_H
#define CYCLOID_URI_H

#include <stddef.h>

/* A path, or a file URI of it, into the path; 1 where it is neither, empty or longer than the size. */
int path_from_uri(const char *uri, char *path, size_t size);

#endif
