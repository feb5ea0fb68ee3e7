/* The decoder of models/decoder.py on a CPU, in one fused pass: new tokens in, final states out.

   Sums run in the same order on every processor: a V is 16 numbers, in as many machine registers as that
   takes, and a product is added by a fused multiply-add.  So results are equal, bit by bit, on all
   processors.  Compile with -ffp-contract=off, so that the compiler fuses nothing by itself, and without
   -ffast-math.

   Context tokens (normalized states, as in models/decoder.py) are stored in chunks of 128 per context: 8
   blocks of D rows of 16 tokens.  The 16 lanes of a V are 16 tokens, so scores need no sum over lanes.
   Softmax is online and by lane: each lane has its own maximum and sums, and the lanes are merged at the
   end.  So a decision reads each token from memory once.

   Rows are padded with zeros to a multiple of 16 numbers; a matrix has inputs as rows and outputs as
   columns. */

#ifndef KIND
#include <stdint.h>

#ifdef __FAST_MATH__
#error "fast math changes the order of sums: compile without it"
#endif
#ifdef __ELF__
/* This file, in the library after what is loaded: models/compiled.py finds a library of other sources by it. */
__asm__(".pushsection .icrl_source\n.incbin \"" __FILE__ "\"\n.popsection");
#endif

#define LANES 16
#define BLOCKS 8               /* per chunk */
#define CHUNK (LANES * BLOCKS) /* tokens per chunk */
#define ROWS 16                /* tokens that pass through the layers together */
#define QUERIES 4              /* queries of one context that read a chunk together */

typedef const float *Linear[2]; /* weight, bias */

typedef struct {
    Linear norm_attention, query, out, norm_mlp, up, down;
} Layer;

typedef struct {
    int32_t width, heads, layers, batch;
    const Layer *layer;
    Linear norm;
    float **chunks; /* chunk c of layer l at [c * layers + l]: (batch, BLOCKS, width, LANES) */
    float *work;    /* icrl_work() numbers */
    int32_t far_away; /* whether the chunks are so large that they do not stay in the second-level cache */
} Decoder;

static inline int padded(int n) { return (n + LANES - 1) / LANES * LANES; }

/* Numbers of scratch memory of a Decoder. */
long icrl_work(int width, int heads) {
    int rows = 2 * padded(width) + 2 * padded(heads * width) + padded(4 * width);
    return (long)ROWS * rows + (long)QUERIES * width * LANES;
}

#define JOIN(name, kind) name##_##kind
#define NAMED(name, kind) JOIN(name, kind)
#define INLINE static inline __attribute__((always_inline)) TARGET

#if defined(__x86_64__)
#include <immintrin.h>
#define KIND avx2
#define TARGET __attribute__((target("avx2,fma")))
#define REGISTERS 2
#define TOGETHER 4 /* blocks whose sums fit into registers */
#define FMA _mm256_fmadd_ps
#include "decoder_kernel.c"
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
#include "decoder_kernel.c"

/* The number of icrl_run_* that this processor can run: 1 for avx2, 2 for avx512 too. */
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
#include "decoder_kernel.c"
int icrl_kinds(void) { return 1; }
#else
int icrl_kinds(void) { return 0; }
#endif

#else /* compiled once for each KIND */

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
    EACH(i) o.r[i] = x + zero;
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
    int r = 0;
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

/* The scores of `count` queries for n blocks of tokens, from block k0 of a chunk on: weight[g][k] for query g
   and block k.  `next`, unless 0, is brought nearer: as many numbers as are read here. */
#define scores NAMED(scores, KIND)
INLINE void scores(V weight[][BLOCKS], const float *const *q, const float *chunk, const float *next, int width, int count, int k0,
                   int n) {
    UNROLL for (int g = 0; g < count; g++) UNROLL for (int k = 0; k < n; k++) weight[g][k0 + k] = all(0.0f);
    for (int d = 0; d < width; d++) UNROLL for (int k = 0; k < n; k++) {
        if (next) __builtin_prefetch(next + ((k0 * width + d * n) + k) * LANES, 0, 2);
        V token = load(chunk + ((k0 + k) * width + d) * LANES);
        UNROLL for (int g = 0; g < count; g++) weight[g][k0 + k] = fma(token, all(q[g][d]), weight[g][k0 + k]);
    }
}

/* Add the tokens of these blocks, times their weights, to `mixed` (count, width, LANES), which is multiplied
   by correction[g] first if this is given. */
#define mix NAMED(mix, KIND)
INLINE void mix(float *mixed, V weight[][BLOCKS], const V *correction, const float *chunk, int width, int count, int k0, int n) {
    for (int d = 0; d < width; d++) UNROLL for (int g = 0; g < count; g++) {
        float *place = mixed + (g * width + d) * LANES;
        V part = load(place);
        if (correction) part = mul(part, correction[g]);
        UNROLL for (int k = 0; k < n; k++) part = fma(load(chunk + ((k0 + k) * width + d) * LANES), weight[g][k0 + k], part);
        store(place, part);
    }
}

/* `count` queries of one context read the first `live` blocks of a chunk; query g sees its first limit[g]
   tokens.  mixed, highest and total: the sums so far, by lane. */
#define attend_chunk NAMED(attend_chunk, KIND)
INLINE void attend_chunk(float *mixed, V *highest, V *total, const float *const *q, const float *chunk, const float *next,
                         const int *limit, int width, int count, int live) {
    V weight[QUERIES][BLOCKS], correction[QUERIES];
    int head = live < TOGETHER ? live : TOGETHER;
    scores(weight, q, chunk, next, width, count, 0, head);
    if (live > head) scores(weight, q, chunk, next, width, count, head, live - head);
    UNROLL for (int g = 0; g < count; g++) {
        V before = highest[g];
        UNROLL for (int k = 0; k < live; k++)
            highest[g] = choose(first_lanes(limit[g] - k * LANES), maximum(highest[g], weight[g][k]), highest[g]);
        correction[g] = exponential(sub(before, highest[g]));
        total[g] = mul(total[g], correction[g]);
        UNROLL for (int k = 0; k < live; k++) {
            V e = exponential(sub(weight[g][k], highest[g]));
            weight[g][k] = choose(first_lanes(limit[g] - k * LANES), e, all(0.0f));
            total[g] = add(total[g], weight[g][k]);
        }
    }
    mix(mixed, weight, correction, chunk, width, count, 0, head);
    if (live > head) mix(mixed, weight, 0, chunk, width, count, head, live - head);
}

/* Attention of up to QUERIES queries of context b in layer l, query g over its first visible[g] tokens.
   What the tokens are weighted to goes to to[g], (width). */
#define attend NAMED(attend, KIND)
INLINE void attend(const Decoder *m, int l, long b, const float *const *q, float *const *to, const long *visible, int count,
                   float *mixed) {
    int width = m->width;
    long most = 0, offset = b * CHUNK * width;
    V highest[QUERIES], total[QUERIES];
    for (int g = 0; g < count; g++) {
        highest[g] = all(-__FLT_MAX__), total[g] = all(0.0f);
        if (visible[g] > most) most = visible[g];
    }
    for (int i = 0; i < count * width; i++) store(mixed + i * LANES, all(0.0f));
    for (long c = 0; c * CHUNK < most; c++) {
        int limit[QUERIES] = {0};
        for (int g = 0; g < count; g++) {
            long left = visible[g] - c * CHUNK;
            limit[g] = left < 0 ? 0 : left > CHUNK ? CHUNK : (int)left;
        }
        const float *chunk = m->chunks[c * m->layers + l] + offset;
        /* What is read next: this context's next chunk, or the next context's first one. */
        const float *next = !m->far_away                ? 0
                            : (c + 1) * CHUNK < most ? m->chunks[(c + 1) * m->layers + l] + offset
                                                     : m->chunks[l] + (b + 1 < m->batch ? offset + CHUNK * width : 0);
        if (count == QUERIES)
            attend_chunk(mixed, highest, total, q, chunk, next, limit, width, QUERIES, BLOCKS);
        else
            for (int g = 0; g < count; g++)
                switch ((limit[g] + LANES - 1) / LANES) {
#define LIVE(n)                                                                                                               \
    case n:                                                                                                                   \
        attend_chunk(mixed + g * width * LANES, highest + g, total + g, q + g, chunk, next, limit + g, width, 1, n);          \
        break;
                    LIVE(1) LIVE(2) LIVE(3) LIVE(4) LIVE(5) LIVE(6) LIVE(7) LIVE(8)
                }
    }
    for (int g = 0; g < count; g++) {
        float lanes[LANES], top;
        store(lanes, highest[g]);
        top = lanes[0];
        for (int i = 1; i < LANES; i++) top = lanes[i] > top ? lanes[i] : top;
        V scale = exponential(sub(highest[g], all(top)));
        scale = mul(scale, all(1.0f / sum(mul(total[g], scale))));
        for (int d = 0; d < width; d += 8) {
            V part[8];
            UNROLL for (int i = 0; i < 8; i++)
                part[i] = d + i < width ? mul(load(mixed + (g * width + d + i) * LANES), scale) : all(0.0f);
            Half sums = sums8(part);
            for (int i = 0; i < 8 && d + i < width; i++) to[g][d + i] = sums[i];
        }
    }
}

/* Put a normalized token at place t of context b in layer l. */
#define put NAMED(put, KIND)
INLINE void put(const Decoder *m, int l, long b, long t, const float *token) {
    long block = t % CHUNK / LANES;
    float *to = m->chunks[t / CHUNK * m->layers + l] + (b * BLOCKS + block) * m->width * LANES + t % LANES;
    for (int d = 0; d < m->width; d++) to[d * LANES] = token[d];
}

/* Pass `length` new tokens of every context, x (batch, length, width), through the layers.  Each sees the
   `past` tokens of its context, the new ones before it, and itself; if `alone`, it does not see the other
   new ones.  The final states of the tokens `first`, `first` + 1, ... of every context go to `states`
   (batch, length - first, width).  The new tokens stay in the chunks at the places from `past` on, which the
   caller has reserved; if `alone`, only the last one stays. */
TARGET void NAMED(icrl_run, KIND)(const Decoder *m, const float *x, float *states, long past, long length, long first, int alone) {
    int width = m->width, heads = m->heads, wide = padded(width), q_wide = padded(heads * width), up_wide = padded(4 * width);
    float *h = m->work, *normed = h + ROWS * wide, *q = normed + ROWS * wide, *attended = q + ROWS * q_wide;
    float *up = attended + ROWS * q_wide, *mixed = up + ROWS * up_wide;
    long tokens = m->batch * length;
    for (long start = 0; start < tokens; start += ROWS) {
        int rows = tokens - start < ROWS ? (int)(tokens - start) : ROWS;
        for (int r = 0; r < rows; r++)
            for (int d = 0; d < wide; d++) h[r * wide + d] = d < width ? x[(start + r) * width + d] : 0.0f;
        for (int l = 0; l < m->layers; l++) {
            const Layer *layer = m->layer + l;
            for (int r = 0; r < rows; r++) {
                layer_norm(normed + r * wide, h + r * wide, layer->norm_attention, width);
                if (!alone) put(m, l, (start + r) / length, past + (start + r) % length, normed + r * wide);
            }
            if (l == m->layers - 1 && first >= length) break; /* nobody reads these tokens' final states */
            linear(q, q_wide, normed, wide, layer->query, width, rows, 0);
            for (int i = 0; i < rows * heads;) {
                const float *query[QUERIES];
                float *to[QUERIES];
                long visible[QUERIES], b = (start + i / heads) / length;
                int count = 0;
                if (alone && i % heads == 0) put(m, l, b, past, normed + i / heads * wide);
                for (; count < QUERIES && i < rows * heads; i++) {
                    long row = start + i / heads;
                    if (row / length != b || (alone && count && i % heads == 0)) break;
                    if (l == m->layers - 1 && row % length < first) continue; /* nobody reads its final state */
                    query[count] = q + i / heads * q_wide + i % heads * width;
                    to[count] = attended + i / heads * q_wide + i % heads * width;
                    visible[count++] = past + (alone ? 0 : row % length) + 1;
                }
                attend(m, l, b, query, to, visible, count, mixed);
            }
            linear(h, wide, attended, q_wide, layer->out, heads * width, rows, 1);
            for (int r = 0; r < rows; r++) layer_norm(normed + r * wide, h + r * wide, layer->norm_mlp, width);
            linear(up, up_wide, normed, wide, layer->up, width, rows, 0);
            for (int i = 0; i < rows * up_wide; i += LANES) store(up + i, gelu(load(up + i)));
            linear(h, wide, up, up_wide, layer->down, 4 * width, rows, 1);
        }
        for (int r = 0; r < rows; r++) {
            long b = (start + r) / length, t = (start + r) % length;
            if (t < first) continue;
            layer_norm(normed, h + r * wide, m->norm, width);
            for (int d = 0; d < width; d++) states[(b * (length - first) + t - first) * width + d] = normed[d];
        }
    }
}

/* Rows x (rows, inputs) times a padded matrix, plus a bias: to (rows, columns). */
TARGET void NAMED(icrl_linear, KIND)(float *to, const float *x, const float *weight, const float *bias, int inputs, int columns,
                                     int rows) {
    const Linear layer = {weight, bias};
    linear(to, columns, x, inputs, layer, inputs, rows, 0);
}

/* Softmax of each row of x (rows, columns), in place; the first n numbers of a row count, the others become 0. */
TARGET void NAMED(icrl_softmax, KIND)(float *x, int columns, int n, int rows) {
    for (int r = 0; r < rows; r++, x += columns) {
        float highest = x[0], total = 0.0f;
        for (int i = 1; i < n; i++) highest = x[i] > highest ? x[i] : highest;
        for (int i = 0; i < columns; i += LANES)
            store(x + i, choose(first_lanes(n - i), exponential(sub(load(x + i), all(highest))), all(0.0f)));
        for (int i = 0; i < n; i++) total += x[i];
        for (int i = 0; i < n; i++) x[i] /= total;
    }
}

#endif
