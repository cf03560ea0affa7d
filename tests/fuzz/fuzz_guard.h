/* Gaps between the core's arrays, which AddressSanitizer watches: see mpc/core/memory.c. */
#ifndef FUZZ_GUARD_H
#define FUZZ_GUARD_H

#include <sanitizer/asan_interface.h>

#define DDMPC_GAP 16
#define DDMPC_GUARD(address, bytes) ASAN_POISON_MEMORY_REGION(address, bytes)
#define DDMPC_RELEASE(address, bytes) ASAN_UNPOISON_MEMORY_REGION(address, bytes)

#endif
