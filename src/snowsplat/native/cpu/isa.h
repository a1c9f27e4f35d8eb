// Instructions that a machine may have in addition to the instruction set of a library.
#pragma once

namespace snow {

// Whether the processor has AVX512-VNNI, and the system saves the registers of AVX-512.
bool has_avx512_vnni();

}  // namespace snow
