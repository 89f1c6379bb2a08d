// Where buffers' memory comes from.
#include "frame.hpp"

#ifdef __linux__
#include <sys/mman.h>
#endif
#ifdef __GLIBC__
#include <malloc.h>
#endif

namespace neeco {

void* allocate(size_t bytes) {
    constexpr size_t line = 64, huge_page = size_t{2} << 20;
    const bool large = bytes >= 2 * huge_page;
    const size_t alignment = large ? huge_page : line;
    void* memory = nullptr;
    if (posix_memalign(&memory, alignment, (bytes + alignment - 1) / alignment * alignment) != 0) out_of_memory();
#ifdef MADV_HUGEPAGE
    // Records, pieces and slots are visited in an order far from their own: with small pages, address translation alone
    // would cost as much as the memory. A refusal is harmless.
    if (large) madvise(memory, (bytes + alignment - 1) / alignment * alignment, MADV_HUGEPAGE);
#endif
    return memory;
}

bool keep_freed_memory() {
#ifdef __GLIBC__
    constexpr int largest = 32 << 20;  // bytes; glibc takes no more as the size from which blocks are mapped one by one
    return mallopt(M_MMAP_THRESHOLD, largest) != 0 && mallopt(M_TRIM_THRESHOLD, 1 << 30) != 0;
#else
    return false;
#endif
}

template class Buffer<uint32_t>;
template class Buffer<int32_t>;
template class Buffer<float>;
template class Buffer<uint64_t>;
template class Buffer<double>;
template class Buffer<Pair>;
template class Buffer<Span>;
template class Buffer<Visible>;
template class Buffer<Run>;

}  // namespace neeco
