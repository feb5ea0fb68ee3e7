/* The decoder of models/decoder.py on a CPU, in one fused pass: new tokens in, final states out.

   Sums run in the same order on every processor (lanes.h).

   Context tokens (normalized states, as in models/decoder.py) are stored in chunks of 128 per context: 8
   blocks of D rows of 16 tokens.  The 16 lanes of a V are 16 tokens, so scores need no sum over lanes.
   Softmax is online and by lane: each lane has its own maximum and sums, and the lanes are merged at the
   end.  So a decision reads each token from memory once. */

#include "lanes.h"

#ifndef KIND
#include <stdint.h>

KEEP_SOURCE

#define BLOCKS 8               /* per chunk */
#define CHUNK (LANES * BLOCKS) /* tokens per chunk */
#define ROWS 16                /* tokens that pass through the layers together */
#define LEAD 1024              /* rows of 16 numbers that are brought nearer ahead of their use: 64 KiB */
#define QUERIES 4              /* queries of one context that read a chunk together */

typedef struct {
    Linear norm_attention, query, out, norm_mlp, up, down;
} Layer;

typedef struct {
    int32_t width, heads, layers, batch;
    const Layer *layer;
    Linear norm;
    float **chunks; /* chunk c of layer l at [c * layers + l]: (batch, BLOCKS, width, LANES) */
    float *work;      /* icrl_work() numbers */
    int32_t far_away; /* whether the chunks are so large that they do not stay in the second-level cache */
} Decoder;

/* Numbers of scratch memory of a Decoder. */
long icrl_work(int width, int heads) {
    int rows = 2 * padded(width) + 2 * padded(heads * width) + padded(4 * width);
    return (long)ROWS * rows + (long)QUERIES * width * LANES;
}

/* Chunks in the order in which they will be read.  With hundreds of environments they lie in memory.  While others are
   read and computed with, they are brought into the second-level cache at the same rate, LEAD rows of 16 numbers
   before their use: so a decision takes little longer than reading them alone. */
typedef struct {
    const Decoder *m;
    const float *at, *end; /* the rest of chunk c of context b in layer l */
    long tokens;           /* of each context */
    long first, b, c;      /* ROWS contexts, from `first` on, pass through the layers together */
    int l;
    int once; /* whether each chunk is read once; else only the next one is brought, in no exact order */
} Ahead;

static void this_chunk(Ahead *a) {
    long left = a->tokens - a->c * CHUNK;
    a->at = a->m->chunks[a->c * a->m->layers + a->l] + a->b * CHUNK * a->m->width;
    a->end = a->at + (left > CHUNK ? CHUNK : padded((int)left)) * a->m->width;
}

static __attribute__((noinline)) void next_chunk(Ahead *a) {
    const Decoder *m = a->m;
    long last = a->first + ROWS < m->batch ? a->first + ROWS : m->batch;
    if (++a->c * CHUNK >= a->tokens) a->c = 0, a->b++;
    if (a->b == last) a->b = a->first, a->l++;
    if (a->l == m->layers) a->l = 0, a->b = a->first = last < m->batch ? last : 0;
    this_chunk(a);
}

static void chunk_after(Ahead *a, int l, long b, long c) {
    a->l = l, a->first = a->b = b, a->c = c;
    next_chunk(a);
}

#define SOURCE "decoder_kernel.c"
#include "lanes.h"

#else /* compiled once for each KIND */

/* Bring some lines of 16 numbers that will be read later into the second-level cache. */
#define bring NAMED(bring, KIND)
INLINE void bring(Ahead *ahead, int lines) {
    UNROLL for (int i = 0; i < lines; i++) __builtin_prefetch(ahead->at + i * LANES, 0, 2);
    ahead->at += lines * LANES;
    if (ahead->at >= ahead->end) next_chunk(ahead);
}

/* The scores of `count` queries for n blocks of tokens, from block k0 of a chunk on: weight[g][k] for query g
   and block k. */
#define scores NAMED(scores, KIND)
INLINE void scores(V weight[][BLOCKS], const float *const *q, const float *chunk, Ahead *ahead, int width, int count, int k0,
                   int n) {
    UNROLL for (int g = 0; g < count; g++) UNROLL for (int k = 0; k < n; k++) weight[g][k0 + k] = all(0.0f);
    for (int d = 0; d < width; d++) {
        if (ahead) bring(ahead, n - n / 2);
        UNROLL for (int k = 0; k < n; k++) {
            V token = load(chunk + ((k0 + k) * width + d) * LANES);
            UNROLL for (int g = 0; g < count; g++) weight[g][k0 + k] = fma(token, all(q[g][d]), weight[g][k0 + k]);
        }
    }
}

/* Add the tokens of these blocks, times their weights, to `mixed` (count, width, LANES), which is multiplied
   by correction[g] first if this is given, or taken as zeros if `begins`. */
#define mix NAMED(mix, KIND)
INLINE void mix(float *mixed, V weight[][BLOCKS], const V *correction, const float *chunk, Ahead *ahead, int width, int count,
                int k0, int n, int begins) {
    for (int d = 0; d < width; d++) {
        if (ahead) bring(ahead, n / 2);
        UNROLL for (int g = 0; g < count; g++) {
            float *place = mixed + (g * width + d) * LANES;
            V part = begins ? all(0.0f) : load(place);
            if (correction) part = mul(part, correction[g]);
            UNROLL for (int k = 0; k < n; k++)
                part = fma(load(chunk + ((k0 + k) * width + d) * LANES), weight[g][k0 + k], part);
            store(place, part);
        }
    }
}

/* `count` queries of one context read the first `live` blocks of a chunk; query g sees its first limit[g]
   tokens.  mixed, highest and total: the sums so far, by lane. */
#define attend_chunk NAMED(attend_chunk, KIND)
INLINE void attend_chunk(float *mixed, V *highest, V *total, const float *const *q, const float *chunk, Ahead *ahead,
                         const int *limit, int width, int count, int live, int begins) {
    V weight[QUERIES][BLOCKS], correction[QUERIES];
    int head = live < TOGETHER ? live : TOGETHER;
    scores(weight, q, chunk, ahead, width, count, 0, head);
    if (live > head) scores(weight, q, chunk, ahead, width, count, head, live - head);
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
    if (begins)
        mix(mixed, weight, 0, chunk, ahead, width, count, 0, head, 1);
    else
        mix(mixed, weight, correction, chunk, ahead, width, count, 0, head, 0);
    if (live > head) mix(mixed, weight, 0, chunk, ahead, width, count, head, live - head, 0);
}

/* Attention of up to QUERIES queries of context b in layer l, query g over its first visible[g] tokens.
   The weighted mean of the tokens goes to to[g], (width). */
#define attend NAMED(attend, KIND)
INLINE void attend(const Decoder *m, int l, long b, const float *const *q, float *const *to, const long *visible, int count,
                   float *mixed, Ahead *ahead) {
    int width = m->width;
    long most = 0, offset = b * CHUNK * width;
    V highest[QUERIES], total[QUERIES];
    for (int g = 0; g < count; g++) {
        highest[g] = all(-__FLT_MAX__), total[g] = all(0.0f);
        if (visible[g] > most) most = visible[g];
    }
    for (long c = 0; c * CHUNK < most; c++) {
        int limit[QUERIES] = {0};
        for (int g = 0; g < count; g++) {
            long left = visible[g] - c * CHUNK;
            limit[g] = left < 0 ? 0 : left > CHUNK ? CHUNK : (int)left;
        }
        const float *chunk = m->chunks[c * m->layers + l] + offset;
        if (ahead && !ahead->once) chunk_after(ahead, l, b, c);
        if (count == QUERIES) {
            int blocks = (limit[QUERIES - 1] + LANES - 1) / LANES; /* the last one sees the most */
            if (blocks <= BLOCKS / 4)
                attend_chunk(mixed, highest, total, q, chunk, ahead, limit, width, QUERIES, BLOCKS / 4, !c);
            else if (blocks <= BLOCKS / 2)
                attend_chunk(mixed, highest, total, q, chunk, ahead, limit, width, QUERIES, BLOCKS / 2, !c);
            else
                attend_chunk(mixed, highest, total, q, chunk, ahead, limit, width, QUERIES, BLOCKS, !c);
        } else
            for (int g = 0; g < count; g++)
                switch ((limit[g] + LANES - 1) / LANES) {
#define LIVE(n)                                                                                                                \
    case n:                                                                                                                    \
        attend_chunk(mixed + g * width * LANES, highest + g, total + g, q + g, chunk, g ? 0 : ahead, limit + g, width, 1, n,   \
                     !c);                                                                                                      \
        break;
                    LIVE(1) LIVE(2) LIVE(3) LIVE(4) LIVE(5) LIVE(6) LIVE(7) LIVE(8)
                }
    }
    for (int g = 0; g < count; g++) {
        float lanes[LANES];
        store(lanes, highest[g]);
        UNROLL for (int n = LANES / 2; n > 0; n /= 2)
            UNROLL for (int i = 0; i < n; i++) lanes[i] = lanes[i] > lanes[i + n] ? lanes[i] : lanes[i + n];
        V scale = exponential(sub(highest[g], all(lanes[0])));
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
TARGET void NAMED(icrl_run, KIND)(const Decoder *m, const float *x, float *states, long past, long length, long first,
                                  int alone) {
    int width = m->width, heads = m->heads, wide = padded(width), q_wide = padded(heads * width), up_wide = padded(4 * width);
    float *h = m->work, *normed = h + ROWS * wide, *q = normed + ROWS * wide, *attended = q + ROWS * q_wide;
    float *up = attended + ROWS * q_wide, *mixed = up + ROWS * up_wide;
    long tokens = m->batch * length;
    /* A token is stored when its context is read, if no other token of the call sees it: then its place is in the cache. */
    int late = alone || (length == 1 && first == 0);
    Ahead far = {.m = m, .tokens = past + length, .once = length == 1 && heads < QUERIES};
    Ahead *ahead = m->far_away && length <= ROWS ? &far : 0;
    if (ahead) this_chunk(ahead);
    for (int i = 0; ahead && far.once && i < LEAD; i += 8) bring(ahead, 8);
    for (long start = 0; start < tokens; start += ROWS) {
        int rows = tokens - start < ROWS ? (int)(tokens - start) : ROWS;
        for (int r = 0; r < rows; r++)
            for (int d = 0; d < wide; d++) h[r * wide + d] = d < width ? x[(start + r) * width + d] : 0.0f;
        for (int l = 0; l < m->layers; l++) {
            const Layer *layer = m->layer + l;
            for (int r = 0; r < rows; r++) {
                layer_norm(normed + r * wide, h + r * wide, layer->norm_attention, width);
                if (!late) put(m, l, (start + r) / length, past + (start + r) % length, normed + r * wide);
            }
            if (l == m->layers - 1 && first >= length) break; /* nobody reads these tokens' final states */
            linear(q, q_wide, normed, wide, layer->query, width, rows, 0);
            for (int i = 0; i < rows * heads;) {
                const float *query[QUERIES];
                float *to[QUERIES];
                long visible[QUERIES], b = (start + i / heads) / length;
                int count = 0, again = i % heads; /* whether the context has just been read for other heads */
                if (late && i % heads == 0) put(m, l, b, past, normed + i / heads * wide);
                for (; count < QUERIES && i < rows * heads; i++) {
                    long row = start + i / heads;
                    if (row / length != b || (alone && count && i % heads == 0)) break;
                    if (l == m->layers - 1 && row % length < first) continue; /* nobody reads its final state */
                    query[count] = q + i / heads * q_wide + i % heads * width;
                    to[count] = attended + i / heads * q_wide + i % heads * width;
                    visible[count++] = past + (alone ? 0 : row % length) + 1;
                }
                attend(m, l, b, query, to, visible, count, mixed, again ? 0 : ahead);
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
