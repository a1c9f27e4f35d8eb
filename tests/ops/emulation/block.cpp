// Runs the blocks of a kernel one after another. Each thread of a block is a fibre with its own stack,
// which is suspended at a barrier and resumed when all threads have arrived. See cuda_emulation.h.
// This file itself is compiled without sanitizers, so that switching between threads is fast.
#include <cstdlib>
#include <cstring>
#include <memory>
#include <string>
#include <vector>

#include "cuda_emulation.h"

#if defined(SNOWSPLAT_SANITIZED)
#include <sanitizer/asan_interface.h>
#include <sanitizer/common_interface_defs.h>
#endif
#if !defined(__x86_64__)
#include <ucontext.h>
#endif

namespace emulation {

EmulatedIndex thread_index, block_index, block_size, grid_size;
int64_t running_block;

namespace {

constexpr size_t kStackBytes = 128 << 10;

enum class State { kReady, kAtBlockBarrier, kAtWarpBarrier, kDone };

// A stack on which threads run, or that of the caller.
struct Stack {
  char* memory = nullptr;
#if defined(__x86_64__)
  void* pointer = nullptr;
#else
  ucontext_t context;
#endif
#if defined(SNOWSPLAT_SANITIZED)
  const void* bottom = nullptr;
  size_t size = kStackBytes;
  void* fake_stack = nullptr;
#endif

  Stack() = default;
  Stack(const Stack&) = delete;
  ~Stack() { std::free(memory); }
};

struct Thread {
  State state = State::kDone;
  Stack* stack = nullptr;  // null: it has not begun, or has ended
  Place place = {"", 0};
  unsigned mask = 0;                // the lanes it waits for
  uint64_t value = 0;               // its value in an exchange
  Exchange exchange = {};           // its last one, if it is the leader
  const Exchange* found = nullptr;  // that of the leader
};

std::vector<Thread> threads;
std::vector<std::unique_ptr<Stack>> stacks;
std::vector<Stack*> idle_stacks;
Stack caller_stack, *current_stack = &caller_stack, *previous_stack;
std::vector<SharedArray*> shared_arrays;  // those of the running block
std::vector<int> order;
size_t turn;       // the position in `order` of the thread that is considered next
int done;          // the number of threads that have ended
int running = -1;  // the running thread, or −1: the caller
// Sums of block_sum, used alternately: while one is read, the next may be written.
int sums[2], sum_turn;
void (*kernel_call)(void**);
void** kernel_args;
std::string error;

void run_threads();

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

void prepare(Stack& s) {
  uintptr_t top = reinterpret_cast<uintptr_t>(s.memory + kStackBytes) & ~uintptr_t(15);
  void** sp = reinterpret_cast<void**>(top);
  *--sp = nullptr;  // aligns the stack as after a call
  *--sp = reinterpret_cast<void*>(&run_threads);
  for (int k = 0; k < 6; k++) *--sp = nullptr;
  s.pointer = sp;
}
void exchange_stacks(Stack& from, Stack& to) { snowsplat_switch_stack(&from.pointer, to.pointer); }
#else
void prepare(Stack& s) {
  getcontext(&s.context);
  s.context.uc_stack.ss_sp = s.memory;
  s.context.uc_stack.ss_size = kStackBytes;
  s.context.uc_link = nullptr;
  makecontext(&s.context, run_threads, 0);
}
void exchange_stacks(Stack& from, Stack& to) { swapcontext(&from.context, &to.context); }
#endif

// The first call on a stack after a switch to it.
void arrive() {
#if defined(SNOWSPLAT_SANITIZED)
  __sanitizer_finish_switch_fiber(current_stack->fake_stack, &previous_stack->bottom,
                                  &previous_stack->size);
#endif
}

// Returns when another stack switches back.
void switch_to(Stack& to) {
  Stack& from = *current_stack;
  previous_stack = &from, current_stack = &to;
#if defined(SNOWSPLAT_SANITIZED)
  __sanitizer_start_switch_fiber(&from.fake_stack, to.bottom, to.size);
#endif
  exchange_stacks(from, to);
  arrive();
}

Stack* idle_stack() {
  if (idle_stacks.empty()) {
    stacks.push_back(std::make_unique<Stack>());
    Stack& s = *stacks.back();
    s.memory = static_cast<char*>(std::aligned_alloc(64, kStackBytes));
#if defined(SNOWSPLAT_SANITIZED)
    s.bottom = s.memory;
#endif
    prepare(s);
    return &s;
  }
  Stack* const last = idle_stacks.back();
  idle_stacks.pop_back();
  return last;
}

std::string text_of(Place place) {
  const char* slash = std::strrchr(place.file, '/');
  return std::string(slash ? slash + 1 : place.file) + ":" + std::to_string(place.line);
}

const char* waits_at(const Thread& f) {
  return f.state == State::kAtBlockBarrier ? "__syncthreads" : "a warp's barrier, shuffle or vote";
}

void fail(const std::string& what) {
  if (error.empty()) error = "block " + std::to_string(block_index.x) + ": " + what;
}

// Resumes the lanes of a warp if all lanes of their mask have arrived at the same place.
bool release_warps() {
  bool released = false;
  const int count = int(threads.size());
  for (int first = 0; first < count; first += kWarpSize) {
    const int lanes = count - first < kWarpSize ? count - first : kWarpSize;
    for (int l = 0; l < lanes; l++) {
      Thread& f = threads[size_t(first + l)];
      if (f.state != State::kAtWarpBarrier) continue;
      bool whole = true;
      for (int k = 0; k < kWarpSize && whole; k++) {
        if (!(f.mask >> k & 1)) continue;
        if (k >= lanes) {
          whole = false;  // as on a GPU, where a missing lane is undefined behaviour
          continue;
        }
        const Thread& other = threads[size_t(first + k)];
        whole =
            other.state == State::kAtWarpBarrier && other.mask == f.mask && other.place == f.place;
      }
      if (!whole) continue;
      f.exchange.votes = 0;
      for (int k = 0; k < lanes; k++)
        if (f.mask >> k & 1) {
          Thread& other = threads[size_t(first + k)];
          f.exchange.values[k] = other.value, f.exchange.votes |= unsigned(other.value != 0) << k;
          other.found = &f.exchange, other.state = State::kReady;
        }
      released = true;
    }
  }
  return released;
}

// Resumes the block if all running threads are at the same barrier.
bool release_block() {
  const Thread* waiting = nullptr;
  for (const Thread& f : threads) {
    if (f.state == State::kDone) continue;
    if (f.state != State::kAtBlockBarrier || (waiting && !(f.place == waiting->place)))
      return false;
    waiting = &f;
  }
  if (!waiting) return false;
  for (Thread& f : threads)
    if (f.state == State::kAtBlockBarrier) f.state = State::kReady;
  sum_turn ^= 1, sums[sum_turn] = 0;
  return true;
}

void report_divergence() {
  int first = -1;
  for (int i = 0; i < int(threads.size()); i++) {
    const Thread& f = threads[size_t(i)];
    if (f.state == State::kDone) continue;
    if (first < 0) {
      first = i;
      continue;
    }
    const Thread& other = threads[size_t(first)];
    if (!(f.place == other.place) || f.state != other.state) {
      fail("divergent barrier: thread " + std::to_string(first) + " waits at " + waits_at(other) +
           " (" + text_of(other.place) + "), thread " + std::to_string(i) + " at " + waits_at(f) +
           " (" + text_of(f.place) + ")");
      return;
    }
  }
  fail("divergent barrier: thread " + std::to_string(first) + " waits at " +
       waits_at(threads[size_t(first)]) + " (" + text_of(threads[size_t(first)].place) +
       ") for lanes that do not come");
}

void set_order(int count) {
  const char* const asked = std::getenv("SNOWSPLAT_ORDER");
  const std::string kind = asked ? asked : "forward";
  order.resize(size_t(count));
  for (int i = 0; i < count; i++) order[size_t(i)] = kind == "backward" ? count - 1 - i : i;
  if (kind == "forward" || kind == "backward") return;
  uint64_t random = std::strtoull(kind.c_str(), nullptr, 10) * 2 + 1;
  for (int i = count - 1; i > 0; i--) {
    random = random * 6364136223846793005ull + 1442695040888963407ull;
    std::swap(order[size_t(i)], order[size_t((random >> 33) % uint64_t(i + 1))]);
  }
}

// The thread that runs next, or −1 if the block has ended. Each ready thread has its turn, in the
// given order; then those that have arrived where they wait become ready.
int next_thread() {
  for (;;) {
    while (turn < order.size()) {
      const int i = order[turn++];
      if (threads[size_t(i)].state == State::kReady) return i;
    }
    if (done == int(threads.size())) return -1;
    if (!release_warps() && !release_block()) {
      report_divergence();
      return -1;
    }
    turn = 0;
  }
}

// Runs the other threads, until it is the turn of the running one.
void run_others() {
  running = next_thread();
  Stack* next = &caller_stack;
  if (running >= 0) {
    thread_index = {unsigned(running), 0, 0};
    Thread& t = threads[size_t(running)];
    if (!t.stack) t.stack = idle_stack();
    next = t.stack;
  }
  if (next != current_stack) switch_to(*next);
}

// Runs threads on a new stack. If one ends, the next that has not begun needs no other stack.
void run_threads() {
  arrive();
  for (;;) {
    kernel_call(kernel_args);
    Thread& t = threads[size_t(running)];
    t.state = State::kDone, t.stack = nullptr, done++;
    idle_stacks.push_back(current_stack);
    run_others();
  }
}

void run_block() {
  running_block++;
  for (Thread& t : threads) t.state = State::kReady, t.stack = nullptr;
  sums[0] = sums[1] = 0, sum_turn = 0;
  turn = 0, done = 0;
  run_others();
#if defined(SNOWSPLAT_SANITIZED)
  for (const SharedArray* array : shared_arrays)
    __asan_poison_memory_region(array->memory, size_t(array->bytes));
#endif
  shared_arrays.clear();
}

}  // namespace

void* begin_shared(SharedArray& array, int64_t bytes) {
  if (!array.memory)
    array.memory = std::aligned_alloc(64, (size_t(bytes) + 63) / 64 * 64), array.bytes = bytes;
#if defined(SNOWSPLAT_SANITIZED)
  __asan_unpoison_memory_region(array.memory, size_t(bytes));
#endif
  std::memset(array.memory, 0xff, size_t(bytes));
  array.block = running_block;
  shared_arrays.push_back(&array);
  return array.memory;
}

void block_barrier(Place at) {
  Thread& f = threads[size_t(running)];
  f.state = State::kAtBlockBarrier, f.place = at;
  run_others();
}

int block_sum(int value, Place at) {
  const int turn = sum_turn;
  sums[turn] += value;
  block_barrier(at);
  return sums[turn];
}

const Exchange& warp_exchange(unsigned mask, uint64_t value, Place at) {
  Thread& f = threads[size_t(running)];
  const int lane = running % kWarpSize;
  if (!(mask >> lane & 1)) {
    fail("lane " + std::to_string(lane) + " is not in the mask that it gives (" + text_of(at) +
         ")");
    mask |= 1u << lane;
  }
  f.value = value;
  f.state = State::kAtWarpBarrier, f.place = at, f.mask = mask;
  run_others();
  return *f.found;
}

unsigned lanes_with(const Exchange& all, unsigned mask, uint64_t value) {
  unsigned same = 0;
  for (int l = 0; l < kWarpSize; l++) same |= unsigned(all.values[l] == value) << l;
  return same & mask;
}

}  // namespace emulation

// Runs a kernel; returns null or an error message.
SNOW_EMULATION_EXPORT const char* emulate(void (*call)(void**), int64_t blocks, int64_t count,
                                          void** args) {
  using namespace emulation;
  error.clear();
  threads.resize(size_t(count));
  set_order(int(count));
  kernel_call = call, kernel_args = args;
  block_size = {unsigned(count), 1, 1}, grid_size = {unsigned(blocks), 1, 1};
  for (int64_t b = 0; b < blocks && error.empty(); b++) {
    block_index = {unsigned(b), 0, 0};
    run_block();
  }
  if (error.empty()) return nullptr;
  idle_stacks.clear(), stacks.clear();  // threads that wait for ever have some of them
  return error.c_str();
}
