/* Makes system calls on files fail, to be loaded before a command (LD_PRELOAD).
 *
 * Only calls on files below the folder FAULT_BELOW take part, and of those only the ones that FAULT_KIND can befall; they
 * are counted from 1. Number FAULT_AT fails, with FAULT_ON all that follow it as well. Every counted call is written to
 * FAULT_LOG, a line each.
 *
 * Kinds: EIO, ENOSPC, EMFILE, EACCES, EINTR, and SHORT, half of what is to be read or written. */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { READS = 1, WRITES = 2, OPENS = 4, CREATES = 8, NAMES = 16, SYNCS = 32 };

static const struct {
    const char *name;
    int error, befalls;
} kinds[] = {
    { "EIO", EIO, READS | WRITES | OPENS | CREATES | NAMES | SYNCS },
    { "ENOSPC", ENOSPC, WRITES | CREATES | SYNCS },
    { "EMFILE", EMFILE, OPENS | CREATES },
    { "EACCES", EACCES, OPENS | CREATES | NAMES },
    { "EINTR", EINTR, READS | WRITES | OPENS | CREATES | SYNCS },
    { "SHORT", 0, READS | WRITES },
};

#define FILES 4096
static const char *below;
static size_t below_length;
static long fault_at;
static int goes_on, kind = -1, log_file = -1;
static atomic_long calls;
/* Which open files are below the folder. */
static atomic_char watched[FILES];

__attribute__((constructor)) static void begin(void) {
    const char *name = getenv("FAULT_KIND"), *at = getenv("FAULT_AT"), *path = getenv("FAULT_LOG");
    below = getenv("FAULT_BELOW");
    goes_on = getenv("FAULT_ON") != NULL;
    if (!below || !name || !at || !path) {
        return;
    }
    for (size_t k = 0; k < sizeof kinds / sizeof *kinds; k++) {
        if (strcmp(name, kinds[k].name) == 0) {
            kind = (int)k;
        }
    }
    fault_at = atol(at);
    below_length = strlen(below);
    log_file = (int)syscall(SYS_openat, AT_FDCWD, path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    if (kind < 0 || log_file < 0) {
        _exit(99);
    }
}

static int is_below(const char *path) {
    return kind >= 0 && path && strncmp(path, below, below_length) == 0;
}

static int is_watched(int file) {
    return file >= 0 && file < FILES && watched[file];
}

/* Counts a call; whether it is to fail, with errno set. */
static int fails(const char *call, int what, const char *path, int file) {
    if (kind < 0 || !(kinds[kind].befalls & what) || !(path ? is_below(path) : is_watched(file))) {
        return 0;
    }
    long number = atomic_fetch_add(&calls, 1) + 1;
    int is_hit = number == fault_at || (goes_on && fault_at > 0 && number > fault_at);
    char line[512];
    int length =
        snprintf(line, sizeof line, "%s%s %s\n", is_hit ? "! " : "", call, path ? path + below_length : "");
    if (length > 0 && length < (int)sizeof line) {
        syscall(SYS_write, log_file, line, (size_t)length);
    }
    if (is_hit) {
        errno = kinds[kind].error;
    }
    return is_hit;
}

#define REAL(name) \
    static __typeof__(name) *real; \
    if (!real) { \
        real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name); \
    }

static int note(int file, const char *path) {
    if (file >= 0 && file < FILES) {
        watched[file] = (char)is_below(path);
    }
    return file;
}

#define MODE(flags) \
    mode_t mode = 0; \
    if ((flags) & (O_CREAT | O_TMPFILE)) { \
        va_list more; \
        va_start(more, flags); \
        mode = va_arg(more, mode_t); \
        va_end(more); \
    }

#define OPENING(flags) ((flags) & O_CREAT ? CREATES : OPENS)

#define OPEN(name) \
    int name(const char *path, int flags, ...) { \
        REAL(name) \
        MODE(flags) \
        return fails("open", OPENING(flags), path, -1) ? -1 : note(real(path, flags, mode), path); \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name) \
    int name(int folder, const char *path, int flags, ...) { \
        REAL(name) \
        MODE(flags) \
        return fails("open", OPENING(flags), path, -1) ? -1 : note(real(folder, path, flags, mode), path); \
    }
OPENAT(openat)
OPENAT(openat64)

DIR *opendir(const char *path) {
    REAL(opendir)
    return fails("opendir", OPENS, path, -1) ? NULL : real(path);
}

int close(int file) {
    REAL(close)
    if (file >= 0 && file < FILES) {
        watched[file] = 0;
    }
    return real(file);
}

/* Half of a length, at least one byte, when that is the fault. */
static size_t cut(size_t length) {
    return length > 1 ? length / 2 : length;
}

#define MOVE(name, what, type, ...) \
    ssize_t name(int file, type data, size_t length __VA_OPT__(, off_t at)) { \
        REAL(name) \
        if (fails(#name, what, NULL, file)) { \
            if (kinds[kind].error) { \
                return -1; \
            } \
            length = cut(length); \
        } \
        return real(file, data, length __VA_OPT__(, at)); \
    }
MOVE(read, READS, void *)
MOVE(write, WRITES, const void *)
MOVE(pread, READS, void *, at)
MOVE(pread64, READS, void *, at)
MOVE(pwrite, WRITES, const void *, at)
MOVE(pwrite64, WRITES, const void *, at)

#define MOVE_MANY(name, what) \
    ssize_t name(int file, const struct iovec *pieces, int count) { \
        REAL(name) \
        if (fails(#name, what, NULL, file)) { \
            if (kinds[kind].error) { \
                return -1; \
            } \
            struct iovec first = { pieces->iov_base, cut(pieces->iov_len) }; \
            return real(file, &first, 1); \
        } \
        return real(file, pieces, count); \
    }
MOVE_MANY(readv, READS)
MOVE_MANY(writev, WRITES)

#define ON_FILE(name, what) \
    int name(int file) { \
        REAL(name) \
        return fails(#name, what, NULL, file) ? -1 : real(file); \
    }
ON_FILE(fsync, SYNCS)
ON_FILE(fdatasync, SYNCS)

int ftruncate(int file, off_t length) {
    REAL(ftruncate)
    return fails("ftruncate", SYNCS, NULL, file) ? -1 : real(file, length);
}

int ftruncate64(int file, off64_t length) {
    REAL(ftruncate64)
    return fails("ftruncate", SYNCS, NULL, file) ? -1 : real(file, length);
}

int rename(const char *from, const char *to) {
    REAL(rename)
    return fails("rename", NAMES, to, -1) ? -1 : real(from, to);
}

int renameat(int here, const char *from, int there, const char *to) {
    REAL(renameat)
    return fails("rename", NAMES, to, -1) ? -1 : real(here, from, there, to);
}

int renameat2(int here, const char *from, int there, const char *to, unsigned flags) {
    REAL(renameat2)
    return fails("rename", NAMES, to, -1) ? -1 : real(here, from, there, to, flags);
}

int unlink(const char *path) {
    REAL(unlink)
    return fails("unlink", NAMES, path, -1) ? -1 : real(path);
}

int unlinkat(int folder, const char *path, int flags) {
    REAL(unlinkat)
    return fails("unlink", NAMES, path, -1) ? -1 : real(folder, path, flags);
}

int mkdir(const char *path, mode_t mode) {
    REAL(mkdir)
    return fails("mkdir", NAMES, path, -1) ? -1 : real(path, mode);
}
