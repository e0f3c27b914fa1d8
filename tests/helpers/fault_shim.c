/* Makes reads or writes of files fail, in every process that loads it by LD_PRELOAD (scripts/fault_campaign).

FAULT_MATCH: what the path of a file holds; FAULT_OP: r or w; FAULT_ERRNO; FAULT_AFTER: calls of a process that go well;
FAULT_MARK: a file that is made at the first failure: there is one only; without it all calls from then on fail. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/uio.h>
#include <unistd.h>

static long calls;

static int fails(int fd, char op)
{
    const char *match = getenv("FAULT_MATCH"), *ops = getenv("FAULT_OP"), *mark = getenv("FAULT_MARK");
    const char *after = getenv("FAULT_AFTER"), *number = getenv("FAULT_ERRNO");
    char link[64], path[4096];
    int before = errno;
    if (!match || !ops || !number || !strchr(ops, op)) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    errno = before;
    if (length < 0) return 0;
    path[length] = 0;
    if (!strstr(path, match)) return 0;
    if (__sync_add_and_fetch(&calls, 1) <= (after ? atol(after) : 0)) return 0;
    if (mark) {
        int made = open(mark, O_CREAT | O_EXCL | O_WRONLY, 0600);
        errno = before;
        if (made < 0) return 0;
        close(made);
    }
    errno = atoi(number);
    return 1;
}

#define WRAP(type, name, op, parameters, ...)                                       \
    type name parameters                                                            \
    {                                                                               \
        static type(*real) parameters;                                              \
        if (!real) real = (type(*) parameters)dlsym(RTLD_NEXT, #name);              \
        return fails(fd, op) ? -1 : real(__VA_ARGS__);                              \
    }

WRAP(ssize_t, read, 'r', (int fd, void *data, size_t n), fd, data, n)
WRAP(ssize_t, pread, 'r', (int fd, void *data, size_t n, off_t at), fd, data, n, at)
WRAP(ssize_t, pread64, 'r', (int fd, void *data, size_t n, off64_t at), fd, data, n, at)
WRAP(ssize_t, preadv, 'r', (int fd, const struct iovec *parts, int n, off_t at), fd, parts, n, at)
WRAP(ssize_t, preadv64, 'r', (int fd, const struct iovec *parts, int n, off64_t at), fd, parts, n, at)
WRAP(ssize_t, preadv2, 'r', (int fd, const struct iovec *parts, int n, off_t at, int how), fd, parts, n, at, how)
WRAP(ssize_t, preadv64v2, 'r', (int fd, const struct iovec *parts, int n, off64_t at, int how), fd, parts, n, at, how)
WRAP(ssize_t, write, 'w', (int fd, const void *data, size_t n), fd, data, n)
WRAP(ssize_t, pwrite, 'w', (int fd, const void *data, size_t n, off_t at), fd, data, n, at)
WRAP(ssize_t, pwrite64, 'w', (int fd, const void *data, size_t n, off64_t at), fd, data, n, at)
WRAP(ssize_t, writev, 'w', (int fd, const struct iovec *parts, int n), fd, parts, n)
WRAP(ssize_t, pwritev, 'w', (int fd, const struct iovec *parts, int n, off_t at), fd, parts, n, at)
WRAP(ssize_t, pwritev64, 'w', (int fd, const struct iovec *parts, int n, off64_t at), fd, parts, n, at)
WRAP(int, fsync, 'w', (int fd), fd)
WRAP(int, fdatasync, 'w', (int fd), fd)
