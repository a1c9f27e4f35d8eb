// What the C++ runtime of GCC takes from a version of glibc after 2.28.

// Whether the process has only one thread. 0 (unknown) makes the runtime use atomic operations.
char __libc_single_threaded = 0;
