/* Lets a User-Mode-Linux kernel set the registers of its processes on a processor that has more than it knows.

   PTRACE_SETREGSET takes the whole extended state or nothing, and this kernel's buffer ends before AMX. The rest is
   filled in from what the process has. Preloaded by vcan-run. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

#define WHOLE (64 * 1024)

typedef long (*ptrace_call)(int request, pid_t process, void *address, void *data);

long ptrace(enum __ptrace_request request, ...)
{
    static ptrace_call next;
    static char whole[WHOLE];
    va_list arguments;
    va_start(arguments, request);
    pid_t process = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *);
    void *data = va_arg(arguments, void *);
    va_end(arguments);
    if (!next)
        next = (ptrace_call)dlsym(RTLD_NEXT, "ptrace");
    if (request == PTRACE_SETREGSET && (long)address == NT_X86_XSTATE) {
        struct iovec *known = data, all = { whole, sizeof whole };
        if (next(PTRACE_GETREGSET, process, address, &all) == 0 && all.iov_len > known->iov_len) {
            memcpy(whole, known->iov_base, known->iov_len);
            return next(request, process, address, &all);
        }
    }
    return next(request, process, address, data);
}
