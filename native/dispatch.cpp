// Which instruction set runs: the widest that the machine has, or the one asked for.
#include <cstdlib>
#include <stdexcept>
#include <string>

#include "kernels.hpp"

namespace neeco {

const Kernels& kernels_sse2();
const Kernels& kernels_avx2();
const Kernels& kernels_avx512();
const Kernels& kernels_neon();

namespace {

struct Candidate {
    const char* name;
    bool runs;
    const Kernels& (*table)();
};

// Widest last.
std::vector<Candidate> candidates() {
    std::vector<Candidate> list;
#if defined(NEECO_HAVE_sse2)
    __builtin_cpu_init();
    list.push_back({"sse2", true, kernels_sse2});
    const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
                      __builtin_cpu_supports("bmi2");
    list.push_back({"avx2", avx2, kernels_avx2});
    const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") &&
                        __builtin_cpu_supports("avx512cd");
    list.push_back({"avx512", avx512, kernels_avx512});
#elif defined(NEECO_HAVE_neon)
    list.push_back({"neon", true, kernels_neon});
#endif
    return list;
}

const Kernels& choose(const std::string& wanted) {
    const Kernels* best = nullptr;
    std::string known;
    for (const Candidate& c : candidates()) {
        if (!c.runs) continue;
        if (wanted.empty() || wanted == c.name) best = &c.table();
        known += known.empty() ? c.name : std::string(", ") + c.name;
    }
    if (!best) throw std::runtime_error("NEECO_SIMD: '" + wanted + "' cannot run here; use one of: " + known);
    return *best;
}

const Kernels* chosen = nullptr;

}  // namespace

const Kernels& kernels() {
    if (!chosen) {
        const char* wanted = std::getenv("NEECO_SIMD");
        chosen = &choose(wanted ? wanted : "");
    }
    return *chosen;
}

void select_kernels(const char* name) { chosen = &choose(name); }

std::vector<const char*> runnable_kernels() {
    std::vector<const char*> names;
    for (const Candidate& c : candidates())
        if (c.runs) names.push_back(c.name);
    return names;
}

}  // namespace neeco
