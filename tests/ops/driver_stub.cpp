// Replaces the driver of a GPU (libcuda.so.1), so that tests can use the real cuda-bindings without a
// GPU: it has the few functions that we call, and records a launch.
#include <cstdint>
#include <cstring>

extern "C" {

int recorded_size[6];
uint64_t recorded_values[4];
void *recorded_function, *recorded_stream, *recorded_context;
char recorded_code[4], recorded_name[64];
int pushed, fail_next;
char layout[1024];

static char context, library, kernel, function;
static void* current;

int cuInit(unsigned) { return 0; }
int cuDriverGetVersion(int* version) { return *version = 12040, 0; }
int cuDeviceGet(int* device, int index) { return *device = index, 0; }
int cuDevicePrimaryCtxRetain(void** made, int) { return *made = &context, 0; }
int cuCtxGetCurrent(void** found) { return *found = current, 0; }
int cuCtxPushCurrent_v2(void* made) { return current = made, pushed++, 0; }
int cuCtxPopCurrent_v2(void** old) { return *old = current, current = nullptr, 0; }
int cuLibraryLoadData(void** made, const void* code, void*, void*, unsigned, void*, void*,
                      unsigned) {
  std::memcpy(recorded_code, code, sizeof recorded_code);
  return *made = &library, 0;
}
int cuLibraryGetKernel(void** found, void*, const char* name) {
  std::strncpy(recorded_name, name, sizeof recorded_name - 1);
  return *found = &kernel, 0;
}
int cuLibraryGetGlobal(void** found, size_t* size, void*, const char* name) {
  *found = std::strstr(name, "_kernel_fields") ? layout : nullptr;
  return *size = sizeof layout, 0;
}
int cuMemcpyDtoH_v2(void* target, const void* source, size_t size) {
  return std::memcpy(target, source, size), 0;
}
int cuKernelGetFunction(void** found, void* of) {
  return *found = of == &kernel ? &function : nullptr, 0;
}
int cuLaunchKernel(void* f, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by,
                   unsigned bz, unsigned, void* stream, void** parameters, void**) {
  const unsigned size[6] = {gx, gy, gz, bx, by, bz};
  for (int i = 0; i < 6; i++) recorded_size[i] = int(size[i]);
  std::memcpy(recorded_values, parameters[0], sizeof recorded_values);
  recorded_function = f == &function ? f : nullptr;
  recorded_stream = stream, recorded_context = current;
  return fail_next;
}
int cuGetErrorName(int, const char** text) { return *text = "CUDA_ERROR_ILLEGAL_ADDRESS", 0; }
int cuGetErrorString(int, const char** text) { return *text = "an illegal memory access", 0; }

int cuGetProcAddress_v2(const char* name, void** found, int, uint64_t, int* status) {
  struct Entry {
    const char* name;
    void* address;
  };
  const Entry entries[] = {
      {"cuInit", (void*)cuInit},
      {"cuDriverGetVersion", (void*)cuDriverGetVersion},
      {"cuDeviceGet", (void*)cuDeviceGet},
      {"cuDevicePrimaryCtxRetain", (void*)cuDevicePrimaryCtxRetain},
      {"cuCtxGetCurrent", (void*)cuCtxGetCurrent},
      {"cuCtxPushCurrent", (void*)cuCtxPushCurrent_v2},
      {"cuCtxPopCurrent", (void*)cuCtxPopCurrent_v2},
      {"cuLibraryLoadData", (void*)cuLibraryLoadData},
      {"cuLibraryGetKernel", (void*)cuLibraryGetKernel},
      {"cuLibraryGetGlobal", (void*)cuLibraryGetGlobal},
      {"cuMemcpyDtoH", (void*)cuMemcpyDtoH_v2},
      {"cuKernelGetFunction", (void*)cuKernelGetFunction},
      {"cuLaunchKernel", (void*)cuLaunchKernel},
      {"cuGetErrorName", (void*)cuGetErrorName},
      {"cuGetErrorString", (void*)cuGetErrorString},
      {"cuGetProcAddress", (void*)cuGetProcAddress_v2},
  };
  *found = nullptr;
  for (const Entry& entry : entries)
    if (!std::strcmp(entry.name, name)) *found = entry.address;
  if (status) *status = *found ? 0 : 1;
  return *found ? 0 : 500;
}
}
