// Runs the blocks of a kernel one after another. Each thread of a block is a fibre with its own stack,
// which is suspended at a barrier and resumed when all threads have arrived. See cuda_emulation.h.
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>

#include "cuda_emulation.h"

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/common_interface_defs.h>
#endif
#if !defined(__x86_64__)
#include <ucontext.h>
#endif

namespace emulation {

EmulatedIndex thread_index, block_index, block_size, grid_size;

namespace {

constexpr size_t kStackBytes = 128 << 10;
constexpr int kWarpSize = 32;

enum class State { kReady, kAtBlockBarrier, kAtWarpBarrier, kDone };

struct Fibre {
  char* stack = nullptr;
  State state = State::kDone;
  Place place = {"", 0};
  unsigned mask = 0;                // the lanes it waits for
  uint64_t value = 0;               // its value in an exchange
  uint64_t values[kWarpSize] = {};  // values of the lanes of its last exchange, if it is the leader
  const uint64_t* found = nullptr;  // the values of the leader
#if defined(__x86_64__)
  void* stack_pointer = nullptr;
#else
  ucontext_t context;
#endif
  void* fake_stack = nullptr;  // AddressSanitizer's
};

struct SharedArray {
  const void* site;
  void* memory;
};

std::vector<Fibre> fibres;
std::vector<SharedArray> shared_arrays;
std::vector<int> order;
int running = -1;  // the running fibre, or −1: the scheduler
// Sums of block_sum, used alternately: while one is read, the next may be written.
int sums[2], sum_turn;
void (*kernel_call)(void**);
void** kernel_args;
std::string error;

#if defined(__x86_64__)
void* scheduler_stack_pointer;
#else
ucontext_t scheduler_context;
#endif
#if defined(__SANITIZE_ADDRESS__)
const void* scheduler_stack_bottom;
size_t scheduler_stack_size;
void* scheduler_fake_stack;
#endif

void run_thread();

#if defined(__x86_64__)
extern "C" void snowsplat_switch_stack(void** save, void* load);
asm(R"(
.text
.hidden snowsplat_switch_stack
.globl snowsplat_switch_stack
snowsplat_switch_stack:
  pushq %rbp
  pushq %rbx
  pushq %r12
  pushq %r13
  pushq %r14
  pushq %r15
  movq %rsp, (%rdi)
  movq %rsi, %rsp
  popq %r15
  popq %r14
  popq %r13
  popq %r12
  popq %rbx
  popq %rbp
  ret
)");

void prepare(Fibre& f) {
  uintptr_t top = reinterpret_cast<uintptr_t>(f.stack + kStackBytes) & ~uintptr_t(15);
  void** sp = reinterpret_cast<void**>(top);
  *--sp = nullptr;  // aligns the stack as after a call
  *--sp = reinterpret_cast<void*>(&run_thread);
  for (int k = 0; k < 6; k++) *--sp = nullptr;
  f.stack_pointer = sp;
}
void enter(Fibre& f) { snowsplat_switch_stack(&scheduler_stack_pointer, f.stack_pointer); }
void leave(Fibre& f) { snowsplat_switch_stack(&f.stack_pointer, scheduler_stack_pointer); }
#else
void prepare(Fibre& f) {
  getcontext(&f.context);
  f.context.uc_stack.ss_sp = f.stack;
  f.context.uc_stack.ss_size = kStackBytes;
  f.context.uc_link = nullptr;
  makecontext(&f.context, run_thread, 0);
}
void enter(Fibre& f) { swapcontext(&scheduler_context, &f.context); }
void leave(Fibre& f) { swapcontext(&f.context, &scheduler_context); }
#endif

// Runs fibre i until it waits or ends.
void resume(int i) {
  Fibre& f = fibres[size_t(i)];
  running = i;
  thread_index = {unsigned(i), 0, 0};
#if defined(__SANITIZE_ADDRESS__)
  __sanitizer_start_switch_fiber(&scheduler_fake_stack, f.stack, kStackBytes);
#endif
  enter(f);
#if defined(__SANITIZE_ADDRESS__)
  __sanitizer_finish_switch_fiber(scheduler_fake_stack, nullptr, nullptr);
#endif
  running = -1;
}

// Back to the scheduler, until it resumes this fibre.
void suspend(bool for_good = false) {
  Fibre& f = fibres[size_t(running)];
#if defined(__SANITIZE_ADDRESS__)
  __sanitizer_start_switch_fiber(for_good ? nullptr : &f.fake_stack, scheduler_stack_bottom,
                                 scheduler_stack_size);
#else
  (void)for_good;
#endif
  leave(f);
#if defined(__SANITIZE_ADDRESS__)
  __sanitizer_finish_switch_fiber(f.fake_stack, &scheduler_stack_bottom, &scheduler_stack_size);
#endif
}

void run_thread() {
#if defined(__SANITIZE_ADDRESS__)
  __sanitizer_finish_switch_fiber(nullptr, &scheduler_stack_bottom, &scheduler_stack_size);
#endif
  kernel_call(kernel_args);
  fibres[size_t(running)].state = State::kDone;
  suspend(true);
}

std::string text_of(Place place) {
  const char* slash = std::strrchr(place.file, '/');
  return std::string(slash ? slash + 1 : place.file) + ":" + std::to_string(place.line);
}

const char* waits_at(const Fibre& f) {
  return f.state == State::kAtBlockBarrier ? "__syncthreads" : "a warp's barrier, shuffle or vote";
}

void fail(const std::string& what) {
  if (error.empty()) error = "block " + std::to_string(block_index.x) + ": " + what;
}

// Resumes the lanes of a warp if all lanes of their mask have arrived at the same place.
bool release_warps() {
  bool released = false;
  const int threads = int(fibres.size());
  for (int first = 0; first < threads; first += kWarpSize) {
    const int lanes = threads - first < kWarpSize ? threads - first : kWarpSize;
    for (int l = 0; l < lanes; l++) {
      Fibre& f = fibres[size_t(first + l)];
      if (f.state != State::kAtWarpBarrier) continue;
      bool whole = true;
      for (int k = 0; k < kWarpSize && whole; k++) {
        if (!(f.mask >> k & 1)) continue;
        if (k >= lanes) {
          whole = false;  // as on a GPU, where a missing lane is undefined behaviour
          continue;
        }
        const Fibre& other = fibres[size_t(first + k)];
        whole =
            other.state == State::kAtWarpBarrier && other.mask == f.mask && other.place == f.place;
      }
      if (!whole) continue;
      for (int k = 0; k < lanes; k++)
        if (f.mask >> k & 1) {
          Fibre& other = fibres[size_t(first + k)];
          f.values[k] = other.value, other.found = f.values, other.state = State::kReady;
        }
      released = true;
    }
  }
  return released;
}

// Resumes the block if all running threads are at the same barrier.
bool release_block() {
  const Fibre* waiting = nullptr;
  for (const Fibre& f : fibres) {
    if (f.state == State::kDone) continue;
    if (f.state != State::kAtBlockBarrier || (waiting && !(f.place == waiting->place)))
      return false;
    waiting = &f;
  }
  if (!waiting) return false;
  for (Fibre& f : fibres)
    if (f.state == State::kAtBlockBarrier) f.state = State::kReady;
  sum_turn ^= 1, sums[sum_turn] = 0;
  return true;
}

void report_divergence() {
  int first = -1;
  for (int i = 0; i < int(fibres.size()); i++) {
    const Fibre& f = fibres[size_t(i)];
    if (f.state == State::kDone) continue;
    if (first < 0) {
      first = i;
      continue;
    }
    const Fibre& other = fibres[size_t(first)];
    if (!(f.place == other.place) || f.state != other.state) {
      fail("divergent barrier: thread " + std::to_string(first) + " waits at " + waits_at(other) +
           " (" + text_of(other.place) + "), thread " + std::to_string(i) + " at " + waits_at(f) +
           " (" + text_of(f.place) + ")");
      return;
    }
  }
  fail("divergent barrier: thread " + std::to_string(first) + " waits at " +
       waits_at(fibres[size_t(first)]) + " (" + text_of(fibres[size_t(first)].place) +
       ") for lanes that do not come");
}

void set_order(int threads) {
  const char* const asked = std::getenv("SNOWSPLAT_ORDER");
  const std::string kind = asked ? asked : "forward";
  order.resize(size_t(threads));
  for (int i = 0; i < threads; i++) order[size_t(i)] = kind == "backward" ? threads - 1 - i : i;
  if (kind == "forward" || kind == "backward") return;
  uint64_t random = std::strtoull(kind.c_str(), nullptr, 10) * 2 + 1;
  for (int i = threads - 1; i > 0; i--) {
    random = random * 6364136223846793005ull + 1442695040888963407ull;
    std::swap(order[size_t(i)], order[size_t((random >> 33) % uint64_t(i + 1))]);
  }
}

void run_block() {
  for (Fibre& f : fibres) prepare(f), f.state = State::kReady;
  sums[0] = sums[1] = 0, sum_turn = 0;
  for (;;) {
    bool ran = false, all_done = true;
    for (int i : order) {
      Fibre& f = fibres[size_t(i)];
      if (f.state == State::kReady) resume(i), ran = true;
      all_done &= f.state == State::kDone;
    }
    if (all_done) break;
    if (release_warps() || ran) continue;
    if (release_block()) continue;
    report_divergence();
    break;
  }
  for (const SharedArray& array : shared_arrays) std::free(array.memory);
  shared_arrays.clear();
}

}  // namespace

void* shared(const void* site, int64_t bytes) {
  for (const SharedArray& array : shared_arrays)
    if (array.site == site) return array.memory;
  void* memory = std::aligned_alloc(64, (size_t(bytes) + 63) / 64 * 64);
  std::memset(memory, 0xff, size_t(bytes));
  shared_arrays.push_back({site, memory});
  return memory;
}

void block_barrier(Place at) {
  Fibre& f = fibres[size_t(running)];
  f.state = State::kAtBlockBarrier, f.place = at;
  suspend();
}

int block_sum(int value, Place at) {
  const int turn = sum_turn;
  sums[turn] += value;
  block_barrier(at);
  return sums[turn];
}

const uint64_t* warp_exchange(unsigned mask, uint64_t value, Place at) {
  Fibre& f = fibres[size_t(running)];
  const int lane = running % kWarpSize;
  if (!(mask >> lane & 1)) {
    fail("lane " + std::to_string(lane) + " is not in the mask that it gives (" + text_of(at) +
         ")");
    mask |= 1u << lane;
  }
  f.value = value;
  f.state = State::kAtWarpBarrier, f.place = at, f.mask = mask;
  suspend();
  return fibres[size_t(running)].found;
}

}  // namespace emulation

// Runs a kernel; returns null or an error message.
SNOW_EMULATION_EXPORT const char* emulate(void (*call)(void**), int64_t blocks, int64_t threads,
                                          void** args) {
  using namespace emulation;
  error.clear();
  while (int64_t(fibres.size()) > threads) std::free(fibres.back().stack), fibres.pop_back();
  while (int64_t(fibres.size()) < threads) {
    fibres.emplace_back();
    fibres.back().stack = static_cast<char*>(std::aligned_alloc(64, kStackBytes));
  }
  set_order(int(threads));
  kernel_call = call, kernel_args = args;
  block_size = {unsigned(threads), 1, 1}, grid_size = {unsigned(blocks), 1, 1};
  for (int64_t b = 0; b < blocks && error.empty(); b++) {
    block_index = {unsigned(b), 0, 0};
    run_block();
  }
  return error.empty() ? nullptr : error.c_str();
}
