/* What the kernels compute with: a V is 16 numbers, in as many machine registers as that takes.

   Sums run in the same order on every processor, and a product is added by a fused multiply-add.  So results
   are equal, bit by bit, on all processors.  Compile with -ffp-contract=off, so that the compiler fuses
   nothing by itself, and without -ffast-math.

   Rows are padded with zeros to a multiple of 16 numbers; a matrix has inputs as rows and outputs as columns.

   A kernel includes this file at its top and, with its own name as SOURCE, once more: then it is compiled once
   for each KIND of instruction set, and the functions below are those of that KIND. */

#ifndef LANES
#define LANES 16

#ifdef __FAST_MATH__
#error "fast math changes the order of sums: compile without it"
#endif
#ifdef __ELF__
/* Put the file into the library, after what is loaded: models/compiled.py finds libraries of other sources by it. */
#define KEEP_SOURCE __asm__(".pushsection .icrl_source\n.incbin \"" __FILE__ "\"\n.popsection");
#else
#define KEEP_SOURCE
#endif
KEEP_SOURCE

typedef const float *Linear[2]; /* weight, bias */

static inline int padded(int n) { return (n + LANES - 1) / LANES * LANES; }

#define JOIN(name, kind) name##_##kind
#define NAMED(name, kind) JOIN(name, kind)
#define INLINE static inline __attribute__((always_inline)) TARGET
#endif

#if !defined(KIND) && defined(SOURCE)
#if defined(__x86_64__)
#include <immintrin.h>
#define KIND avx2
#define TARGET __attribute__((target("avx2,fma")))
#define REGISTERS 2
#define TOGETHER 4 /* blocks whose sums fit into registers */
#define FMA _mm256_fmadd_ps
#include SOURCE
#undef KIND
#undef TARGET
#undef REGISTERS
#undef TOGETHER
#undef FMA
#define KIND avx512
#define TARGET __attribute__((target("avx512f,avx2,fma")))
#define REGISTERS 1
#define TOGETHER 8
#define FMA _mm512_fmadd_ps
#include SOURCE

/* The number of kinds that this processor can run: 1 for avx2, 2 for avx512 too. */
int icrl_kinds(void) {
    int avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    return avx2 + (avx2 && __builtin_cpu_supports("avx512f"));
}
#elif defined(__aarch64__)
#include <arm_neon.h>
#define KIND neon
#define TARGET
#define REGISTERS 4
#define TOGETHER 4
#define FMA(a, b, c) vfmaq_f32(c, a, b)
#include SOURCE
int icrl_kinds(void) { return 1; }
#else
int icrl_kinds(void) { return 0; }
#endif

#elif defined(KIND)
#define REGISTER_LANES (LANES / REGISTERS)
#define R NAMED(R, KIND)
#define B NAMED(B, KIND)
#define V NAMED(V, KIND)
#define M NAMED(M, KIND)
#define Half NAMED(Half, KIND)
#define EACH(i) _Pragma("GCC unroll 4") for (int i = 0; i < REGISTERS; i++)
#define UNROLL _Pragma("GCC unroll 16")

typedef float R __attribute__((vector_size(4 * REGISTER_LANES), aligned(4), may_alias));
typedef float Half __attribute__((vector_size(4 * LANES / 2), aligned(4), may_alias));
typedef int32_t B __attribute__((vector_size(4 * REGISTER_LANES), aligned(4), may_alias));
typedef struct { R r[REGISTERS]; } V; /* 16 numbers */
typedef struct { B r[REGISTERS]; } M; /* 16 truth values, 0 or -1 */

#define load NAMED(load, KIND)
INLINE V load(const float *p) { V o; EACH(i) o.r[i] = *(const R *)(p + i * REGISTER_LANES); return o; }
#define store NAMED(store, KIND)
INLINE void store(float *p, V v) { EACH(i) *(R *)(p + i * REGISTER_LANES) = v.r[i]; }
#define all NAMED(all, KIND)
INLINE V all(float x) {
    const R zero = {0};
    V o;
    EACH(i) o.r[i] = x - zero; /* which leaves -0 as it is, so the compiler makes it a broadcast */
    return o;
}
#define add NAMED(add, KIND)
INLINE V add(V a, V b) { EACH(i) a.r[i] += b.r[i]; return a; }
#define sub NAMED(sub, KIND)
INLINE V sub(V a, V b) { EACH(i) a.r[i] -= b.r[i]; return a; }
#define mul NAMED(mul, KIND)
INLINE V mul(V a, V b) { EACH(i) a.r[i] *= b.r[i]; return a; }
#define fma NAMED(fma, KIND)
INLINE V fma(V a, V b, V c) { EACH(i) a.r[i] = (R)FMA(a.r[i], b.r[i], c.r[i]); return a; }
#define greater NAMED(greater, KIND)
INLINE M greater(V a, V b) { M o; EACH(i) o.r[i] = a.r[i] > b.r[i]; return o; }
#define choose NAMED(choose, KIND)
INLINE V choose(M m, V a, V b) { EACH(i) a.r[i] = (R)((m.r[i] & (B)a.r[i]) | (~m.r[i] & (B)b.r[i])); return a; }
#define maximum NAMED(maximum, KIND)
INLINE V maximum(V a, V b) { return choose(greater(a, b), a, b); }
/* True in the lanes 0 .. n - 1. */
#define first_lanes NAMED(first_lanes, KIND)
INLINE M first_lanes(int n) {
    static const int32_t lanes[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    M o;
    EACH(i) o.r[i] = *(const B *)(lanes + i * REGISTER_LANES) < n;
    return o;
}

#define PAIR(a, b, first, last) __builtin_shufflevector(a, b, first) + __builtin_shufflevector(a, b, last)
#define FIRST4 0, 1, 2, 3, 8, 9, 10, 11
#define LAST4 4, 5, 6, 7, 12, 13, 14, 15
#define FIRST2 0, 1, 8, 9, 4, 5, 12, 13
#define LAST2 2, 3, 10, 11, 6, 7, 14, 15
#define EVEN 0, 8, 2, 10, 4, 12, 6, 14
#define ODD 1, 9, 3, 11, 5, 13, 7, 15

/* The sums over the lanes of x[0], ..., x[7]: halves of the lanes are added to each other, then quarters,
   and so on. */
#define sums8 NAMED(sums8, KIND)
INLINE Half sums8(const V *x) {
    Half a[8];
    UNROLL for (int i = 0; i < 8; i++) a[i] = ((const Half *)(x + i))[0] + ((const Half *)(x + i))[1];
    UNROLL for (int i = 0; i < 4; i++) a[i] = PAIR(a[i], a[i + 4], FIRST4, LAST4);
    UNROLL for (int i = 0; i < 2; i++) a[i] = PAIR(a[i], a[i + 2], FIRST2, LAST2);
    return PAIR(a[0], a[1], EVEN, ODD);
}
/* The sum over the lanes of v, in the same order. */
#define sum NAMED(sum, KIND)
INLINE float sum(V v) {
    Half a = ((const Half *)&v)[0] + ((const Half *)&v)[1];
    a = PAIR(a, a, FIRST4, LAST4);
    a = PAIR(a, a, FIRST2, LAST2);
    a = PAIR(a, a, EVEN, ODD);
    return a[0];
}

/* e^x for x <= 0, to 2 units in the last place; 0 below -87. */
#define exponential NAMED(exponential, KIND)
INLINE V exponential(V x) {
    M tiny = greater(all(-87.0f), x);
    x = choose(tiny, all(-87.0f), x);
    V magic = all(12582912.0f); /* 1.5 * 2^23: adding it rounds to an integer */
    V shifted = fma(x, all(1.44269504f), magic), n = sub(shifted, magic);
    V r = fma(n, all(2.12194440e-4f), fma(n, all(-0.693359375f), x)), p = all(1.0f / 720);
    p = fma(p, r, all(1.0f / 120));
    p = fma(p, r, all(1.0f / 24));
    p = fma(p, r, all(1.0f / 6));
    p = fma(p, r, all(0.5f));
    p = fma(p, r, all(1.0f));
    p = fma(p, r, all(1.0f));
    EACH(i) p.r[i] *= (R)(((B)shifted.r[i] - (B)magic.r[i] + 127) << 23);
    return choose(tiny, all(0.0f), p);
}

/* x * Phi(x), the exact GELU, to 1e-6: Phi(x) - 1/2 is x times a polynomial in x^2, fitted at Chebyshev
   nodes of x^2 in [0, 5.1^2].  Beyond 5.1 Phi is taken as 0 or 1. */
#define gelu NAMED(gelu, KIND)
INLINE V gelu(V x) {
    static const float coefficient[] = {-0.00197806023f, 0.00237223133f, -0.00318478164f, 0.00687977253f,
                                        -0.0120577663f,  0.0174616184f,  -0.0240058731f,  0.0317158587f,
                                        -0.04021997f,    0.0507830307f,  -0.0690032169f,  0.138605282f};
    V squared = mul(x, x), u = fma(squared, all(2.0f / (5.1f * 5.1f)), all(-1.0f)), p = all(0.000671075948f);
    UNROLL for (int i = 0; i < 12; i++) p = fma(p, u, all(coefficient[i]));
    V inside = mul(x, fma(x, p, all(0.5f)));
    return choose(greater(squared, all(5.1f * 5.1f)), maximum(x, all(0.0f)), inside);
}

/* Layer normalization of one row. */
#define layer_norm NAMED(layer_norm, KIND)
INLINE void layer_norm(float *to, const float *x, const Linear norm, int width) {
    V total = all(0.0f), squares = all(0.0f);
    for (int i = 0; i < width; i += LANES) total = add(total, load(x + i));
    V mean = all(sum(total) / (float)width);
    for (int i = 0; i < width; i += LANES) {
        V d = choose(first_lanes(width - i), sub(load(x + i), mean), all(0.0f));
        squares = fma(d, d, squares);
        store(to + i, d);
    }
    V scale = all(1.0f / __builtin_sqrtf(sum(squares) / (float)width + 1e-5f));
    for (int i = 0; i < width; i += LANES)
        store(to + i, fma(mul(load(to + i), scale), load(norm[0] + i), load(norm[1] + i)));
}

/* A tile of `linear`: `rows` rows, `vectors` times 16 columns. */
#define tile NAMED(tile, KIND)
INLINE void tile(float *to, int columns, const float *x, int stride, const float *w, const float *bias, int inputs, int rows,
                 int vectors, int more) {
    V total[4][4];
    UNROLL for (int r = 0; r < rows; r++) UNROLL for (int v = 0; v < vectors; v++) total[r][v] = load(bias + v * LANES);
    for (int i = 0; i < inputs; i++) UNROLL for (int v = 0; v < vectors; v++) {
        V weight = load(w + (long)i * columns + v * LANES);
        UNROLL for (int r = 0; r < rows; r++) total[r][v] = fma(weight, all(x[r * stride + i]), total[r][v]);
    }
    UNROLL for (int r = 0; r < rows; r++) UNROLL for (int v = 0; v < vectors; v++) {
        float *place = to + r * columns + v * LANES;
        store(place, more ? add(load(place), total[r][v]) : total[r][v]);
    }
}

/* Rows x (rows, stride), of which the first `inputs` numbers are used, times a matrix, plus a bias, and plus
   what is in `to` (rows, columns) if `more`. */
#define linear NAMED(linear, KIND)
INLINE void linear(float *to, int columns, const float *x, int stride, const Linear layer, int inputs, int rows, int more) {
    long r = 0;
#define TILES(rows_, vectors)                                                                                                  \
    for (; c + vectors * LANES <= columns; c += vectors * LANES)                                                               \
    tile(to + r * columns + c, columns, x + r * stride, stride, layer[0] + c, layer[1] + c, inputs, rows_, vectors, more)
    for (; r + 4 <= rows; r += 4) {
        int c = 0;
        TILES(4, 2);
        TILES(4, 1);
    }
    for (; r < rows; r++) {
        int c = 0;
        TILES(1, 4);
        TILES(1, 1);
    }
}
#endif
