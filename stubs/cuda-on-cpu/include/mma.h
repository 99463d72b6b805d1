// Products of small matrices by 32 units together: each holds every 32nd number of a matrix, counted row by row.
#pragma once
#include <cuda_bf16.h>
#include <cuda_fp16.h>
namespace nvcuda {
namespace wmma {
struct matrix_a {};
struct matrix_b {};
struct accumulator {};
struct row_major {};
struct col_major {};
enum layout_t { mem_row_major, mem_col_major };

inline unsigned unit() { return threadIdx.x + blockDim.x * (threadIdx.y + blockDim.y * threadIdx.z); }

template <class Use, int M, int N, int K, class T, class Layout = void> struct fragment {
    static constexpr int rows = std::is_same<Use, matrix_b>::value ? K : M;
    static constexpr int cols = std::is_same<Use, matrix_a>::value ? K : N;
    static constexpr int num_elements = rows * cols / 32;
    static constexpr bool by_columns = std::is_same<Layout, col_major>::value;
    T x[num_elements];
};

// f(place in x, row, column) for the unit's share of a matrix.
template <class F, class G> void each(G g) {
    for (int i = 0; i < F::num_elements; i++) {
        int at = i * 32 + unit() % 32;
        g(i, at / F::cols, at % F::cols);
    }
}

template <class F, class T> void fill_fragment(F &f, T v) {
    for (auto &x : f.x) x = v;
}
template <class F, class T> void load(F &f, const T *p, unsigned stride, bool by_columns) {
    cuda_on_cpu::wait_for(false);
    each<F>([&](int i, int r, int c) { f.x[i] = by_columns ? p[c * stride + r] : p[r * stride + c]; });
    cuda_on_cpu::wait_for(false);
}
template <class F, class T> void load_matrix_sync(F &f, const T *p, unsigned stride) { load(f, p, stride, F::by_columns); }
template <class F, class T> void load_matrix_sync(F &f, const T *p, unsigned stride, layout_t l) { load(f, p, stride, l == mem_col_major); }
template <class F, class T> void store_matrix_sync(T *p, const F &f, unsigned stride, layout_t l) {
    cuda_on_cpu::wait_for(false);
    each<F>([&](int i, int r, int c) { p[l == mem_col_major ? c * stride + r : r * stride + c] = f.x[i]; });
    cuda_on_cpu::wait_for(false);
}
// Both factors are laid out for all units of the plane to read.
inline thread_local float left[32][512], right[32][512];
template <class D, class A, class B, class C> void mma_sync(D &d, const A &a, const B &b, const C &c) {
    float *l = left[unit() / 32], *r = right[unit() / 32];
    each<A>([&](int i, int row, int col) { l[row * A::cols + col] = float(a.x[i]); });
    each<B>([&](int i, int row, int col) { r[col * B::rows + row] = float(b.x[i]); });
    cuda_on_cpu::wait_for(false);
    each<D>([&](int i, int row, int col) {
        float sum = float(c.x[i]);
        for (int k = 0; k < A::cols; k++) sum += l[row * A::cols + k] * r[col * B::rows + k];
        d.x[i] = sum;
    });
    cuda_on_cpu::wait_for(false);
}
} // namespace wmma
} // namespace nvcuda
