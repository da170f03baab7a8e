/* Preloaded into a program, makes one of its calls to the system fail: the FAULT_AT-th of kind FAULT_KIND on what lies under FAULT_PLACE, with
 * the error FAULT_ERRNO. Calls of all its processes are counted together, by kind, in the file FAULT_COUNT, so that a run without FAULT_KIND tells
 * how many there are.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static const char *const KINDS[] = {"write", "sync", "rename", "lock", "connect"};

/* The C library's own, of the same type. */
#define REAL(name) \
    static __typeof__(name) *real; \
    if (!real) real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)

static long *counted(void) {
    static long *where;
    if (where) return where;
    const char *name = getenv("FAULT_COUNT");
    if (!name) return NULL;
    int fd = open(name, O_RDWR | O_CLOEXEC);
    if (fd < 0) return NULL;
    void *at = mmap(NULL, sizeof KINDS / sizeof *KINDS * sizeof(long), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    close(fd);
    if (at != MAP_FAILED) where = at;
    return where;
}

/* Whether this call has to fail; errno is set then. */
static int fails(const char *kind, const char *path) {
    const char *wanted = getenv("FAULT_KIND"), *place = getenv("FAULT_PLACE"), *at = getenv("FAULT_AT"), *error = getenv("FAULT_ERRNO");
    if (!place || (path && strncmp(path, place, strlen(place)))) return 0;
    long *count = counted();
    if (!count) return 0;
    int which = 0;
    while (strcmp(KINDS[which], kind)) which++;
    long number = __sync_add_and_fetch(count + which, 1);
    if (!wanted || strcmp(wanted, kind) || !at || !error || number != atol(at)) return 0;
    errno = atoi(error);
    return 1;
}

static int fails_on(const char *kind, int fd) {
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    int before = errno;
    ssize_t n = readlink(link, path, sizeof path - 1);
    errno = before;
    if (n < 0) return 0;
    path[n] = 0;
    return fails(kind, path);
}

ssize_t write(int fd, const void *data, size_t size) {
    REAL(write);
    return fails_on("write", fd) ? -1 : real(fd, data, size);
}

ssize_t writev(int fd, const struct iovec *parts, int count) {
    REAL(writev);
    return fails_on("write", fd) ? -1 : real(fd, parts, count);
}

ssize_t pwrite(int fd, const void *data, size_t size, off_t at) {
    REAL(pwrite);
    return fails_on("write", fd) ? -1 : real(fd, data, size, at);
}

ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at) {
    REAL(pwrite64);
    return fails_on("write", fd) ? -1 : real(fd, data, size, at);
}

ssize_t sendfile(int out, int in, off_t *at, size_t size) {
    REAL(sendfile);
    return fails_on("write", out) ? -1 : real(out, in, at, size);
}

ssize_t sendfile64(int out, int in, off64_t *at, size_t size) {
    REAL(sendfile64);
    return fails_on("write", out) ? -1 : real(out, in, at, size);
}

int fsync(int fd) {
    REAL(fsync);
    return fails_on("sync", fd) ? -1 : real(fd);
}

int fdatasync(int fd) {
    REAL(fdatasync);
    return fails_on("sync", fd) ? -1 : real(fd);
}

int rename(const char *from, const char *to) {
    REAL(rename);
    return fails("rename", to) ? -1 : real(from, to);
}

int renameat(int a, const char *from, int b, const char *to) {
    REAL(renameat);
    return fails("rename", to) ? -1 : real(a, from, b, to);
}

int connect(int fd, const struct sockaddr *to, socklen_t size) {
    REAL(connect);
    return fails("connect", NULL) ? -1 : real(fd, to, size);
}

static int locks(int command) { return command == F_SETLK || command == F_SETLKW || command == F_OFD_SETLK; }

int fcntl(int fd, int command, ...) {
    REAL(fcntl);
    va_list more;
    va_start(more, command);
    void *given = va_arg(more, void *);
    va_end(more);
    if (locks(command) && ((struct flock *)given)->l_type != F_UNLCK && fails_on("lock", fd)) return -1;
    return real(fd, command, given);
}

int fcntl64(int fd, int command, ...) {
    REAL(fcntl64);
    va_list more;
    va_start(more, command);
    void *given = va_arg(more, void *);
    va_end(more);
    if (locks(command) && ((struct flock *)given)->l_type != F_UNLCK && fails_on("lock", fd)) return -1;
    return real(fd, command, given);
}
