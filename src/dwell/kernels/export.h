#pragma once

// Begins the declaration of a function that Python calls; all others stay inside the library.
#define DWELL_EXPORT extern "C" __attribute__((visibility("default")))
