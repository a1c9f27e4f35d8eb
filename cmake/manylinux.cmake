# A toolchain file for libraries that run on every Linux with glibc 2.28 or later, used by `make wheel`.
#
# GCC compiles the kernels, as in a build for this machine. Zig links them, because it has the symbols of
# older versions of glibc for every processor. The processor is the variable SNOWSPLAT_MACHINE.
set(CMAKE_TRY_COMPILE_PLATFORM_VARIABLES SNOWSPLAT_MACHINE)
set(CMAKE_SYSTEM_NAME Linux)
set(CMAKE_SYSTEM_PROCESSOR ${SNOWSPLAT_MACHINE})
set(CMAKE_CXX_COMPILER ${SNOWSPLAT_MACHINE}-linux-gnu-g++)

# The C++ runtime is that of GCC. It is linked statically, and its symbols are hidden.
execute_process(
    COMMAND ${CMAKE_CXX_COMPILER} -print-file-name=libstdc++.a
    OUTPUT_VARIABLE libstdcxx OUTPUT_STRIP_TRAILING_WHITESPACE)
execute_process(
    COMMAND ${CMAKE_CXX_COMPILER} -print-libgcc-file-name
    OUTPUT_VARIABLE libgcc OUTPUT_STRIP_TRAILING_WHITESPACE)
set(folder ${CMAKE_CURRENT_LIST_DIR})
string(CONCAT CMAKE_CXX_CREATE_SHARED_MODULE
    "python-zig cc -target ${SNOWSPLAT_MACHINE}-linux-gnu.2.28 -O2 -shared -s"
    " -Wl,--gc-sections -Wl,--version-script=${folder}/exports.map -o <TARGET> <OBJECTS>"
    " ${folder}/glibc_2_28.c ${libstdcxx} ${libgcc} -lm -lpthread -lgcc_s")
