// CUDA's driver and its run-time compiler, played by the CPU, as far as CubeCL calls them: kernels are compiled by the
// machine's C++ compiler and run cube by cube. For checking the CUDA build on machines without such a GPU; slow.
//
//   g++ -O2 -shared -fPIC -pthread driver.cpp -o libcuda.so -ldl && ln -s libcuda.so libnvrtc.so
//   CUDA_PATH=<this folder> LD_LIBRARY_PATH=<where the libraries are> diorama bench check --device cuda
//
// Compiled kernels are kept in $CUDA_ON_CPU_CACHE, or in a folder of the process that is removed at its end. With
// $CUDA_ON_CPU_LAUNCHES set, the end tells how often each kernel was launched.
#include <atomic>
#include <chrono>
#include <csetjmp>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <dlfcn.h>
#include <fstream>
#include <functional>
#include <iterator>
#include <memory>
#include <regex>
#include <string>
#include <sys/mman.h>
#include <sys/stat.h>
#include <thread>
#include <ucontext.h>
#include <unistd.h>
#include <vector>

#include "include/cuda_on_cpu.h"
using cuda_on_cpu::Place;

#define API extern "C" __attribute__((visibility("default")))
typedef int Result;
static const Result OK = 0, INVALID = 1, NOT_FOUND = 500;

// ---- compiling ----

struct Program {
    std::string source, log, library;
    std::vector<std::string> options;
};

static std::string folder() {
    if (const char *kept = getenv("CUDA_ON_CPU_CACHE")) {
        mkdir(kept, 0777);
        return kept;
    }
    static std::string own = [] {
        char name[] = "/tmp/cuda_on_cpu_XXXXXX";
        std::string made = mkdtemp(name);
        static std::string remove = "rm -rf " + made;
        atexit([] { (void)!system(remove.c_str()); });
        return made;
    }();
    return own;
}

static std::string read_file(const std::string &path) {
    std::ifstream f(path);
    return std::string(std::istreambuf_iterator<char>(f), {});
}

// CUDA C++ as C++: shared memory is a pointer, and the few PTX instructions are functions.
static std::string translated(const std::string &source, std::string &entry) {
    std::string s = std::regex_replace(source, std::regex(R"(typedef [a-z ]+ u?int\d+_t;)"), "");
    s = std::regex_replace(s, std::regex(R"(extern __shared__ (__align__\(\d+\) )?char (\w+)\[\];)"), "char *$2 = cuda_on_cpu::shared_memory;");
    std::regex atom(R"(asm volatile\s*\(\s*"atom\.relaxed\.(\w+)\.(\w+) %0, \[%1\], %2(, %3)?;"\s*:\s*"=\w"\(([^()]*)\)\s*:\s*"l"\(([^()]*)\),\s*"\w"\(([^()]*)\)(,\s*"\w"\(([^()]*)\))?\s*(:\s*"memory")?\s*\))");
    std::string out;
    auto at = s.cbegin();
    for (std::smatch m; std::regex_search(at, s.cend(), m, atom); at = m.suffix().first) {
        out.append(at, m[0].first);
        std::string type = m[2] == "f32" ? "float" : "uint32_t";
        std::string third = m[7].matched ? ", (" + type + ")(" + m[8].str() + ")" : "";
        out += m[4].str() + " = cuda_on_cpu::atomic_" + m[1].str() + "((" + type + " *)(" + m[5].str() + "), (" + type + ")(" + m[6].str() + ")" + third + ")";
    }
    out.append(at, s.cend());
    // Two numbers at once are two numbers one after the other.
    std::regex pair(R"(asm volatile\s*\(\s*"atom\.relaxed\.add\.v2\.f32 \{%0, %1\}, \[%2\], \{%3, %4\};"\s*:\s*"=f"\(([^()]*)\),\s*"=f"\(([^()]*)\)\s*:\s*"l"\(([^()]*)\),\s*"f"\(([^()]*)\),\s*"f"\(([^()]*)\)\s*\))");
    out = std::regex_replace(out, pair, "$1 = cuda_on_cpu::atomic_add((float *)($3), (float)($4)); $2 = cuda_on_cpu::atomic_add((float *)($3) + 1, (float)($5))");
    std::regex global(R"(__global__\s+void\s+(?:__launch_bounds__\s*\([^)]*\)\s*)?(\w+)\s*\()");
    std::smatch m;
    if (std::regex_search(out, m, global)) entry = m[1];
    return out;
}

API Result nvrtcCreateProgram(Program **p, const char *source, const char *, int, const char *const *, const char *const *) {
    *p = new Program{source, "", "", {}};
    return OK;
}

API Result nvrtcCompileProgram(Program *p, int n, const char *const *options) {
    std::string include;
    for (int i = 0; i < n; i++)
        if (!strncmp(options[i], "--include-path=", 15) && include.empty()) include = options[i] + 15;
    std::string entry, body = translated(p->source, entry);
    body = "#include <cuda_on_cpu.h>\n" + body + "\nextern \"C\" void cuda_on_cpu_run(void **p) { cuda_on_cpu::call(" + entry + ", p); }\n" +
           "extern \"C\" void cuda_on_cpu_at(cuda_on_cpu::Place **p, char ***s, void (***w)(bool)) { *p = &cuda_on_cpu::place; *s = &cuda_on_cpu::shared_memory; *w = &cuda_on_cpu::wait_for; }\n";
    std::string base = folder() + "/" + std::to_string(std::hash<std::string>()(body));
    if (access((base + ".so").c_str(), R_OK)) {
        std::ofstream(base + ".cpp") << body;
        std::string make = "g++ -w -std=c++17 -O2 -fno-strict-aliasing -shared -fPIC -I'" + include + "' '" + base + ".cpp' -o '" + base + ".part' > '" + base + ".log' 2>&1 && mv '" + base + ".part' '" + base + ".so'";
        if (system(make.c_str())) {
            p->log = read_file(base + ".log");
            return 6;
        }
    }
    p->library = base + ".so\n" + (body.find("__sync") != std::string::npos || body.find("wmma") != std::string::npos ? "fibers" : "plain");
    return OK;
}
API Result nvrtcGetPTXSize(Program *p, size_t *n) { *n = p->library.size() + 1; return OK; }
API Result nvrtcGetPTX(Program *p, char *out) { strcpy(out, p->library.c_str()); return OK; }
API Result nvrtcGetProgramLogSize(Program *p, size_t *n) { *n = p->log.size() + 1; return OK; }
API Result nvrtcGetProgramLog(Program *p, char *out) { strcpy(out, p->log.c_str()); return OK; }
API Result nvrtcDestroyProgram(Program **p) { delete *p; *p = nullptr; return OK; }
API const char *nvrtcGetErrorString(Result) { return "see the log"; }
API Result nvrtcVersion(int *major, int *minor) { *major = 12; *minor = 8; return OK; }

// ---- running ----

struct Kernel {
    void (*run)(void **);
    void (*at)(Place **, char ***, void (***)(bool));
    bool fibers;
    std::string name;
    uint64_t launches;
};
static std::vector<Kernel *> kernels;

namespace {
const size_t STACK = 128 << 10;
enum State { READY, WARP, CUBE, DONE };
struct Fiber {
    ucontext_t start;
    jmp_buf here;
    bool started;
    State state;
    Place place;
};
// A worker's cubes, one at a time.
struct Worker {
    std::vector<Fiber> fibers;
    char *stacks = (char *)mmap(nullptr, STACK * 1024, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    jmp_buf scheduler;
    Fiber *current = nullptr;
    Kernel *kernel = nullptr;
    void **params = nullptr;
    ~Worker() { munmap(stacks, STACK * 1024); }
};
thread_local Worker *worker;

void wait_for(bool whole_cube) {
    Worker *w = worker;
    if (!w || !w->current) {
        fprintf(stderr, "cuda-on-cpu: a barrier in a kernel that was taken to have none\n");
        abort();
    }
    w->current->state = whole_cube ? CUBE : WARP;
    if (!_setjmp(w->current->here)) _longjmp(w->scheduler, 1);
}

void begin() {
    Worker *w = worker;
    w->kernel->run(w->params);
    w->current->state = DONE;
    _longjmp(w->scheduler, 1);
}

void run_cube(Worker &w, const Place &cube, Place *place) {
    unsigned n = cube.block_dim.x * cube.block_dim.y * cube.block_dim.z;
    unsigned left = n;
    w.fibers.resize(n);
    for (unsigned i = 0; i < n; i++) {
        Fiber &f = w.fibers[i];
        f.started = false;
        f.state = READY;
        f.place = cube;
        f.place.thread = {i % cube.block_dim.x, i / cube.block_dim.x % cube.block_dim.y, i / (cube.block_dim.x * cube.block_dim.y)};
    }
    while (left) {
        for (unsigned i = 0; i < n; i++) {
            Fiber &f = w.fibers[i];
            if (f.state != READY) continue;
            w.current = &f;
            *place = f.place;
            if (!_setjmp(w.scheduler)) {
                if (f.started) _longjmp(f.here, 1);
                f.started = true;
                getcontext(&f.start);
                f.start.uc_stack.ss_sp = w.stacks + i * STACK;
                f.start.uc_stack.ss_size = STACK;
                f.start.uc_link = nullptr;
                makecontext(&f.start, begin, 0);
                setcontext(&f.start);
            }
            left -= w.current->state == DONE;
        }
        bool any = left == 0, cube_waits = true;
        for (unsigned first = 0; first < n; first += 32) {
            bool warp_waits = true, some = false;
            for (unsigned i = first; i < std::min(first + 32, n); i++) {
                State s = w.fibers[i].state;
                warp_waits &= s == WARP || s == DONE;
                cube_waits &= s == CUBE || s == DONE;
                some |= s == WARP;
            }
            if (warp_waits && some) {
                any = true;
                for (unsigned i = first; i < std::min(first + 32, n); i++)
                    if (w.fibers[i].state == WARP) w.fibers[i].state = READY;
            }
        }
        if (cube_waits && left) {
            any = true;
            for (Fiber &f : w.fibers)
                if (f.state == CUBE) f.state = READY;
        }
        if (!any) {
            fprintf(stderr, "cuda-on-cpu: units wait at different barriers\n");
            abort();
        }
    }
    w.current = nullptr;
}
} // namespace

API Result cuLaunchKernel(Kernel *k, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz, unsigned shared, void *, void **params, void **) {
    k->launches++;
    std::atomic<uint64_t> next{0};
    uint64_t cubes = uint64_t(gx) * gy * gz;
    auto work = [&] {
        Place *place;
        char **memory;
        void (**wait)(bool);
        k->at(&place, &memory, &wait);
        static thread_local Worker own;
        worker = &own;
        own.kernel = k;
        own.params = params;
        // Shared memory holds garbage at first, as on a device.
        std::vector<char> bytes(shared + 256, char(0x7f));
        *memory = (char *)((uintptr_t(bytes.data()) + 127) & ~uintptr_t(127));
        *wait = wait_for;
        for (uint64_t c; (c = next++) < cubes;) {
            Place cube{{0, 0, 0}, {unsigned(c % gx), unsigned(c / gx % gy), unsigned(c / (uint64_t(gx) * gy))}, {bx, by, bz}, {gx, gy, gz}};
            if (k->fibers) {
                run_cube(own, cube, place);
                continue;
            }
            *place = cube;
            for (unsigned z = 0; z < bz; z++)
                for (unsigned y = 0; y < by; y++)
                    for (unsigned x = 0; x < bx; x++) {
                        place->thread = {x, y, z};
                        k->run(params);
                    }
        }
        worker = nullptr;
    };
    unsigned threads = cubes > 3 ? std::min<unsigned>(std::thread::hardware_concurrency(), 8) : 1;
    std::vector<std::thread> others;
    for (unsigned i = 1; i < threads; i++) others.emplace_back(work);
    work();
    for (auto &t : others) t.join();
    return OK;
}

API Result cuModuleLoadData(void **module, const void *image) {
    std::string text = (const char *)image;
    std::string path = text.substr(0, text.find('\n'));
    void *lib = dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
    if (!lib) {
        fprintf(stderr, "cuda-on-cpu: %s\n", dlerror());
        return INVALID;
    }
    auto k = new Kernel{(void (*)(void **))dlsym(lib, "cuda_on_cpu_run"), nullptr, text.find("fibers", path.size()) != std::string::npos, "", 0};
    if (kernels.empty() && getenv("CUDA_ON_CPU_LAUNCHES"))
        atexit([] {
            for (Kernel *k : kernels) fprintf(stderr, "%8lu %s\n", (unsigned long)k->launches, k->name.c_str());
        });
    kernels.push_back(k);
    k->at = (decltype(k->at))dlsym(lib, "cuda_on_cpu_at");
    *module = k;
    return OK;
}
API Result cuModuleGetFunction(void **f, void *module, const char *name) {
    ((Kernel *)module)->name = name;
    *f = module;
    return OK;
}
API Result cuModuleUnload(void *) { return OK; }
API Result cuFuncSetAttribute(void *, int, int) { return OK; }

// ---- device, memory, order: everything happens at once ----

API Result cuInit(unsigned) { return OK; }
API Result cuDriverGetVersion(int *v) { *v = 12080; return OK; }
API Result cuDeviceGetCount(int *n) { *n = 1; return OK; }
API Result cuDeviceGet(int *d, int i) { *d = i; return i ? 101 : OK; }
API Result cuDeviceGetName(char *out, int n, int) { snprintf(out, n, "CPU playing CUDA"); return OK; }
API Result cuDeviceGetUuid(char *out, int) { memset(out, 1, 16); return OK; }
API Result cuDeviceGetUuid_v2(char *out, int) { memset(out, 1, 16); return OK; }
API Result cuDeviceGetPCIBusId(char *out, int n, int) { snprintf(out, n, "0000:00:00.0"); return OK; }
API Result cuDeviceTotalMem_v2(size_t *n, int) { *n = size_t(16) << 30; return OK; }
API Result cuMemGetInfo_v2(size_t *left, size_t *all) { *left = *all = size_t(16) << 30; return OK; }
API Result cuDeviceGetAttribute(int *v, int attribute, int) {
    switch (attribute) {
    case 75: *v = 8; break;                 // compute capability
    case 76: *v = 0; break;
    case 10: *v = 32; break;                // warp
    case 8: *v = 48 << 10; break;           // shared memory
    case 97: *v = 160 << 10; break;         // the same, if asked for
    case 1: case 2: case 3: *v = 1024; break;
    case 4: *v = 64; break;
    case 5: *v = 0x7fffffff; break;         // grid
    case 6: case 7: *v = 65535; break;
    case 16: *v = 4; break;                 // multiprocessors
    default: *v = 1;
    }
    return OK;
}
API Result cuDevicePrimaryCtxRetain(void **c, int) { *c = (void *)1; return OK; }
API Result cuDevicePrimaryCtxRelease_v2(int) { return OK; }
API Result cuCtxSetCurrent(void *) { return OK; }
API Result cuCtxGetCurrent(void **c) { *c = (void *)1; return OK; }
API Result cuCtxSynchronize() { return OK; }
API Result cuCtxGetStreamPriorityRange(int *a, int *b) { *a = *b = 0; return OK; }
API Result cuStreamCreate(void **s, unsigned) { *s = (void *)2; return OK; }
API Result cuStreamCreateWithPriority(void **s, unsigned, int) { *s = (void *)2; return OK; }
API Result cuStreamDestroy_v2(void *) { return OK; }
API Result cuStreamSynchronize(void *) { return OK; }
API Result cuStreamWaitEvent(void *, void *, unsigned) { return OK; }
API Result cuEventCreate(void **e, unsigned) { *e = new std::chrono::steady_clock::time_point; return OK; }
API Result cuEventDestroy_v2(void *e) { delete (std::chrono::steady_clock::time_point *)e; return OK; }
API Result cuEventRecord(void *e, void *) { *(std::chrono::steady_clock::time_point *)e = std::chrono::steady_clock::now(); return OK; }
API Result cuEventSynchronize(void *) { return OK; }
API Result cuEventQuery(void *) { return OK; }
API Result cuEventElapsedTime(float *ms, void *a, void *b) {
    typedef std::chrono::steady_clock::time_point T;
    *ms = std::chrono::duration<float, std::milli>(*(T *)b - *(T *)a).count();
    return OK;
}
API Result cuEventElapsedTime_v2(float *ms, void *a, void *b) { return cuEventElapsedTime(ms, a, b); }
// What nobody wrote is not zero on a device either.
static void *garbage(size_t n) {
    void *p = aligned_alloc(512, (n + 511) / 512 * 512);
    if (p) memset(p, 0x7f, n);
    return p;
}
API Result cuMemAlloc_v2(void **p, size_t n) { *p = garbage(n); return *p ? OK : 2; }
API Result cuMemAllocAsync(void **p, size_t n, void *) { return cuMemAlloc_v2(p, n); }
API Result cuMemFree_v2(void *p) { free(p); return OK; }
API Result cuMemFreeAsync(void *p, void *) { free(p); return OK; }
API Result cuMemAllocHost_v2(void **p, size_t n) { return cuMemAlloc_v2(p, n); }
API Result cuMemFreeHost(void *p) { free(p); return OK; }
API Result cuMemcpyHtoDAsync_v2(void *to, const void *from, size_t n, void *) { memcpy(to, from, n); return OK; }
API Result cuMemcpyDtoHAsync_v2(void *to, const void *from, size_t n, void *) { memcpy(to, from, n); return OK; }
API Result cuMemcpyDtoDAsync_v2(void *to, const void *from, size_t n, void *) { memcpy(to, from, n); return OK; }
API Result cuMemsetD8Async(void *to, unsigned char v, size_t n, void *) { memset(to, v, n); return OK; }
struct Copy2D {
    size_t from_x, from_y;
    int from_kind;
    const char *from_host;
    const char *from_device;
    void *from_array;
    size_t from_pitch, to_x, to_y;
    int to_kind;
    char *to_host;
    char *to_device;
    void *to_array;
    size_t to_pitch, width, height;
};
API Result cuMemcpy2DAsync_v2(const Copy2D *c, void *) {
    const char *from = c->from_kind == 1 ? c->from_host : c->from_device;
    char *to = c->to_kind == 1 ? c->to_host : c->to_device;
    for (size_t y = 0; y < c->height; y++) memcpy(to + y * c->to_pitch, from + y * c->from_pitch, c->width);
    return OK;
}
API Result cuGetErrorName(Result, const char **s) { *s = "CUDA_ERROR"; return OK; }
API Result cuGetErrorString(Result, const char **s) { *s = "refused by the CPU that plays CUDA"; return OK; }
