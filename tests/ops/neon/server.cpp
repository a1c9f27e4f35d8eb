// Calls functions of a library of CPU kernels: see __init__.py. The argument is the path of the
// library. Requests are read from stdin, replies are written to stdout. All numbers have 8 bytes:
//
//   request: the length of a name, the name, the hash of its struct, the number of threads,
//            the number of words of the struct, the words,
//            the number of blocks of memory, and for each its size and its address modulo 64,
//            the number of pointers, and for each its word, its block and its offset in the block,
//            the contents of the blocks
//   reply:   the result of the function, and the contents of the blocks
#include <dlfcn.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <string>
#include <vector>

namespace {

[[noreturn]] void fail(const std::string& message) {
  std::fprintf(stderr, "%s\n", message.c_str());
  std::exit(1);
}

void read(void* to, size_t size) {
  if (std::fread(to, 1, size, stdin) != size) fail("the request is incomplete");
}
uint64_t number() {
  uint64_t value = 0;
  read(&value, sizeof value);
  return value;
}

struct Block {
  size_t size;
  std::unique_ptr<char[]> memory;
  char* data;
  Block(size_t size, size_t modulo_64) : size(size), memory(new char[size + 128]) {
    data = memory.get() + (64 - reinterpret_cast<uintptr_t>(memory.get()) % 64) + modulo_64;
  }
};

}  // namespace

int main(int, char** arguments) {
  void* library = dlopen(arguments[1], RTLD_NOW);
  if (!library) fail(dlerror());
  auto find = [&](const std::string& name) {
    void* found = dlsym(library, name.c_str());
    if (!found) fail("the library has no " + name);
    return found;
  };
  auto set_num_threads = reinterpret_cast<int64_t (*)(int64_t)>(find("set_num_threads"));

  for (int first; (first = std::getc(stdin)) != EOF;) {
    std::ungetc(first, stdin);
    std::string name(number(), 0);
    read(&name[0], name.size());
    std::string layout(number(), 0);
    read(&layout[0], layout.size());
    auto fields = reinterpret_cast<const char* (*)()>(find(name + "_fields"));
    if (layout != fields()) fail(name + " takes another struct");
    set_num_threads(int64_t(number()));
    std::vector<uint64_t> words(number());
    read(words.data(), 8 * words.size());
    std::vector<Block> blocks;
    for (uint64_t n = number(); n > 0; n--) {
      const uint64_t size = number();
      blocks.emplace_back(size, number());
    }
    for (uint64_t n = number(); n > 0; n--) {
      uint64_t& word = words.at(number());
      char* data = blocks.at(number()).data;
      word = reinterpret_cast<uint64_t>(data + number());
    }
    for (const Block& block : blocks) read(block.data, block.size);
    const int64_t result = reinterpret_cast<int64_t (*)(const void*)>(find(name))(words.data());
    std::fwrite(&result, sizeof result, 1, stdout);
    for (const Block& block : blocks) std::fwrite(block.data, 1, block.size, stdout);
    std::fflush(stdout);
  }
}
