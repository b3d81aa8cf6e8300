// Digest and compiler of the library. The loader compares the digest with the sources.

#include "export.h"

// The build hook (hatch_build.py) defines both; the loader rejects a library built without it.
#ifndef DWELL_DIGEST
#define DWELL_DIGEST ""
#endif
#ifndef DWELL_COMPILER
#define DWELL_COMPILER ""
#endif

DWELL_EXPORT const char* dwell_digest() noexcept { return DWELL_DIGEST; }

DWELL_EXPORT const char* dwell_compiler() noexcept { return DWELL_COMPILER; }
