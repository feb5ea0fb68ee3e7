/* Loss and gradients of models/dpt.py on a CPU, one context at a time: a forward pass that keeps what the backward pass needs.

   Sums run in the same order on every processor (lanes.h), and a context is computed by one thread, so neither
   the processor nor the number of threads changes a result.

   A context has T tokens and Q queries: single ones, then the tokens of its action windows.  Both go through the
   layers as the rows 0 .. T - 1 and T .. T + Q - 1 of the same matrices.  Token t sees the tokens up to itself; a
   query sees a prefix of the tokens, and the rows of its own window up to itself.  In the last layer tokens have
   keys and values only.

   Heads are padded to a multiple of 16 numbers each, so a row of q, k and v has 3 H numbers, H = heads * E. */

#include "lanes.h"

#ifndef KIND
#include <stdint.h>
#include <string.h>

KEEP_SOURCE

#define BLOCK 16 /* rows whose attention weights are in memory at once */

/* Places of the parameters in `weight`, `back` and a gradient, as indices of `place`. */
enum { TOKEN, QUERY, NORM, NORM_BIAS, HEAD, HEAD_BIAS, LAYERS };
enum { NORM_1, NORM_1_BIAS, QKV, QKV_BIAS, OUT, OUT_BIAS, NORM_2, NORM_2_BIAS, UP, UP_BIAS, DOWN, DOWN_BIAS, PER_LAYER };

typedef struct {
    int32_t width, heads, layers, actions, gaussian, window;
    int32_t token_inputs, query_inputs; /* numbers per row of `token` and `query` */
    int32_t tokens, queries;            /* per context in `token` and `query` */
    const int64_t *place;
    const float *weight; /* matrices (inputs, outputs) and biases */
    const float *back;   /* the same matrices as (outputs, inputs) */
    const float *token;    /* (B, tokens, token_inputs) */
    const float *query;    /* (B, queries, query_inputs) */
    const float *label;    /* (B, queries, padded actions) */
    const int32_t *length; /* (B): the first tokens, which are used */
    const int32_t *prefix; /* (B, queries): the tokens that each query sees */
    const int32_t *own;    /* (queries): the rows of its own window, up to itself */
    float share;           /* weight of the loss of one query */
} Fit;

/* What the backward pass needs of a layer, by row: its input, the normalized input, q, k and v, what attention
   gives, the sum of input and attention, the same normalized, and the inputs of the GELU. */
typedef struct {
    float *x, *normed, *qkv, *mixed, *middle, *normed_middle, *up;
} Saved;

typedef struct {
    int width, heads, tokens, rows;
    int wide, head, up; /* padded: the width, that of a head, that of the feed-forward layer */
    long mixed;         /* heads * head */
    long span;          /* attention weights of a row: of the tokens, then of its own window, both padded */
    int *limit, *own;   /* tokens and rows of its own window that each row sees */
} Shape;

/* Numbers of scratch memory for a context of this many tokens. */
long icrl_fit_work(int width, int heads, int layers, int actions, int tokens, int queries, int window) {
    long wide = padded(width), mixed = heads * padded(width / heads), up = padded(4 * width), rows = tokens + queries;
    long saved = 4 * wide + 4 * mixed + up, passing = 2 * wide + 2 * up + 4 * mixed + 2 * padded(actions) + 2;
    long span = padded(tokens) + padded(window);
    return rows * ((layers + 1) * saved + passing) + 2 * BLOCK * span + 2 * mixed / heads * padded(tokens);
}

/* The next n numbers of scratch memory. */
static inline float *take(float **work, long n) { return (*work += n) - n; }

/* Rows and vectors of a tile of a product, so that its sums fit into registers. */
#define TILE_ROWS (REGISTERS == 1 ? 8 : 6)
#define TILE_VECTORS (REGISTERS == 1 ? 2 : 1)

/* A function that is called, not made a part of its callers: it is large, and has several. */
#define APART static __attribute__((noinline)) TARGET

#define SOURCE "training_kernel.c"
#include "lanes.h"

#else /* compiled once for each KIND */

/* c = start + a b, for `rows` rows and `vectors` times 16 columns; see `product`. */
#define product_tile NAMED(product_tile, KIND)
INLINE void product_tile(float *c, long cs, const float *a, long ar, long ai, const float *b, long bs, long inner,
                         const float *start, long ss, int rows, int vectors) {
    V total[8][4];
    UNROLL for (int r = 0; r < rows; r++) UNROLL for (int v = 0; v < vectors; v++)
        total[r][v] = start ? load(start + r * ss + v * LANES) : all(0.0f);
    for (long i = 0; i < inner; i++) {
        V line[4];
        UNROLL for (int v = 0; v < vectors; v++) line[v] = load(b + i * bs + v * LANES);
        UNROLL for (int r = 0; r < rows; r++) {
            V number = all(a[r * ar + i * ai]);
            UNROLL for (int v = 0; v < vectors; v++) total[r][v] = fma(line[v], number, total[r][v]);
        }
    }
    UNROLL for (int r = 0; r < rows; r++) UNROLL for (int v = 0; v < vectors; v++) store(c + r * cs + v * LANES, total[r][v]);
}

/* c = start + a b: c (rows, columns), row r at c + r cs; start the same with ss, or 0 for zeros, or c itself;
   a (rows, inner), number (r, i) at a[r ar + i ai]; b (inner, columns), row i at b + i bs.  Every number of c
   is a sum over `inner` in order. */
#define product NAMED(product, KIND)
APART void product(float *c, long cs, const float *a, long ar, long ai, const float *b, long bs, long inner, const float *start,
                   long ss, long rows, long columns) {
#define ROWS_OF(rows_, vectors)                                                                                                \
    for (; r + rows_ <= rows; r += rows_)                                                                                      \
    product_tile(c + r * cs + k, cs, a + r * ar, ar, ai, b + k, bs, inner, start ? start + r * ss + k : 0, ss, rows_, vectors)
#define COLUMNS(vectors)                                                                                                       \
    for (; k + vectors * LANES <= columns; k += vectors * LANES) {                                                             \
        long r = 0;                                                                                                            \
        ROWS_OF(TILE_ROWS, vectors);                                                                                           \
        ROWS_OF(4, vectors);                                                                                                   \
        ROWS_OF(1, vectors);                                                                                                   \
    }
    long k = 0;
    COLUMNS(TILE_VECTORS)
    COLUMNS(1)
#undef ROWS_OF
#undef COLUMNS
}

/* The first `columns` numbers of each of `rows` rows as columns: to (columns, stride). */
#define transpose NAMED(transpose, KIND)
APART void transpose(float *to, long stride, const float *x, long xs, long rows, long columns) {
    for (long c = 0; c < columns; c++) {
        for (long r = 0; r < rows; r++) to[c * stride + r] = x[r * xs + c];
        for (long r = rows; r < stride; r++) to[c * stride + r] = 0.0f;
    }
}

/* to += the sum of the rows of x, in order. */
#define add_rows NAMED(add_rows, KIND)
INLINE void add_rows(float *to, const float *x, long stride, long rows, long columns) {
    for (long c = 0; c < columns; c += LANES) {
        V total = load(to + c);
        for (long r = 0; r < rows; r++) total = add(total, load(x + r * stride + c));
        store(to + c, total);
    }
}

#define add_to NAMED(add_to, KIND)
INLINE void add_to(float *to, const float *a, const float *b, int n) {
    for (int i = 0; i < n; i += LANES) store(to + i, add(load(a + i), load(b + i)));
}

#define dot NAMED(dot, KIND)
INLINE float dot(const float *a, const float *b, int n) {
    V total = all(0.0f);
    for (int i = 0; i < n; i += LANES) total = fma(load(a + i), load(b + i), total);
    return sum(total);
}

/* to += factor x */
#define add_scaled NAMED(add_scaled, KIND)
INLINE void add_scaled(float *to, float factor, const float *x, int n) {
    for (int i = 0; i < n; i += LANES) store(to + i, fma(all(factor), load(x + i), load(to + i)));
}

/* The natural logarithm of x > 0, to 2 units in the last place; infinity and nan as they are. */
#define logarithm NAMED(logarithm, KIND)
INLINE V logarithm(V x) {
    static const float coefficient[] = {-1.1514610310e-1f, 1.1676998740e-1f, -1.2420140846e-1f, 1.4249322787e-1f,
                                        -1.6668057665e-1f, 2.0000714765e-1f, -2.4999993993e-1f, 3.3333331174e-1f};
    V power, p = all(7.0376836292e-2f), given = x;
    M finite = greater(all(__builtin_inff()), x);
    EACH(i) { /* x = 2^power times a number from sqrt(1/2) to sqrt(2) */
        B bits = (B)x.r[i], whole = (bits - 0x3f3504f3) >> 23;
        power.r[i] = __builtin_convertvector(whole, R);
        x.r[i] = (R)(bits - (whole << 23));
    }
    x = sub(x, all(1.0f));
    V squared = mul(x, x);
    UNROLL for (int i = 0; i < 8; i++) p = fma(p, x, all(coefficient[i]));
    p = fma(power, all(-2.12194440e-4f), mul(mul(p, x), squared));
    p = fma(squared, all(-0.5f), p);
    return choose(finite, fma(power, all(0.693359375f), add(x, p)), given);
}

/* The derivative of the GELU, to 5e-6: like `gelu`, 1/2 plus x times a polynomial in x^2. */
#define gelu_slope NAMED(gelu_slope, KIND)
INLINE V gelu_slope(V x) {
    static const float coefficient[] = {-0.0078838558f, 0.00456782845f, -0.0074777636f, 0.0272718788f, -0.0439125284f,
                                        0.0532901317f,  -0.0675946691f, 0.0804427621f,  -0.0825805519f, 0.0762794965f,
                                        -0.067577634f,  0.0634307068f,  -0.0728951467f, 0.139203587f};
    V squared = mul(x, x), u = fma(squared, all(2.0f / (5.1f * 5.1f)), all(-1.0f)), p = all(0.00347591096f);
    UNROLL for (int i = 0; i < 14; i++) p = fma(p, u, all(coefficient[i]));
    V beyond = choose(greater(x, all(0.0f)), all(1.0f), all(0.0f));
    return choose(greater(squared, all(5.1f * 5.1f)), beyond, fma(x, p, all(0.5f)));
}

/* dx += the gradient of the input x of a layer normalization, given that of its output, dy; the gradients of its
   weight and bias are added to theirs.  All are nan if the variance overflows: `layer_norm` then gives zeros, and a fit
   would go on without these numbers. */
#define layer_norm_back NAMED(layer_norm_back, KIND)
INLINE void layer_norm_back(float *dx, const float *dy, const float *x, const float *weight, float *d_weight, float *d_bias,
                            int width) {
    V total = all(0.0f), squares = all(0.0f), first = all(0.0f), second = all(0.0f);
    for (int i = 0; i < width; i += LANES) total = add(total, load(x + i));
    V mean = all(sum(total) / (float)width);
    for (int i = 0; i < width; i += LANES) {
        V d = choose(first_lanes(width - i), sub(load(x + i), mean), all(0.0f));
        squares = fma(d, d, squares);
    }
    float variance = sum(squares) / (float)width;
    V scale = all(1.0f / __builtin_sqrtf(variance - variance + variance + 1e-5f));
    for (int i = 0; i < width; i += LANES) {
        V normed = mul(sub(load(x + i), mean), scale), d = load(dy + i), weighted = mul(d, load(weight + i));
        store(d_weight + i, fma(d, normed, load(d_weight + i)));
        store(d_bias + i, add(d, load(d_bias + i)));
        first = add(first, weighted);
        second = fma(weighted, normed, second);
    }
    V mean_first = all(sum(first) / (float)width), mean_second = all(sum(second) / (float)width);
    for (int i = 0; i < width; i += LANES) {
        V normed = mul(sub(load(x + i), mean), scale), weighted = mul(load(dy + i), load(weight + i));
        V d = mul(sub(sub(weighted, mean_first), mul(normed, mean_second)), scale);
        store(dx + i, choose(first_lanes(width - i), add(load(dx + i), d), all(0.0f)));
    }
}

/* The attention weights of the rows first .. first + rows - 1 for one head, p (rows, span): `columns` context
   tokens, then the rows of the own window.  q: of these rows; k: of row 0; across: keys of the tokens as columns. */
#define weigh NAMED(weigh, KIND)
static TARGET void weigh(float *p, const Shape *s, int first, int rows, int columns, const float *q, const float *k,
                         const float *across) {
    long stride = 3 * s->mixed;
    product(p, s->span, q, stride, 1, across, padded(s->tokens), s->head, 0, 0, rows, columns);
    for (int r = 0; r < rows; r++) {
        int limit = s->limit[first + r], own = s->own[first + r], end = columns + padded(own);
        float *row = p + r * s->span, lanes[LANES];
        for (int j = 0; j < own; j++) row[columns + j] = dot(q + r * stride, k + (first + r - own + 1 + j) * stride, s->head);
        for (int j = own; j < end - columns; j++) row[columns + j] = 0.0f;
#define SEEN(c) first_lanes((c) < columns ? limit - (c) : own + columns - (c))
        V top = all(-1e30f), total = all(0.0f);
        for (int c = 0; c < end; c += LANES) top = choose(SEEN(c), maximum(top, load(row + c)), top);
        store(lanes, top);
        for (int i = 1; i < LANES; i++) lanes[0] = lanes[i] > lanes[0] ? lanes[i] : lanes[0];
        top = all(lanes[0]);
        for (int c = 0; c < end; c += LANES) {
            V e = choose(SEEN(c), exponential(sub(load(row + c), top)), all(0.0f));
            total = add(total, e);
            store(row + c, e);
        }
        V scale = all(1.0f / sum(total));
        for (int c = 0; c < end; c += LANES) store(row + c, mul(load(row + c), scale));
#undef SEEN
    }
}

/* The most context tokens that one of these rows sees. */
#define most_seen NAMED(most_seen, KIND)
INLINE int most_seen(const Shape *s, int first, int rows) {
    int most = 0;
    for (int r = first; r < first + rows; r++) most = s->limit[r] > most ? s->limit[r] : most;
    return most;
}

/* The rows of the next block, which holds tokens or queries. */
#define block_rows NAMED(block_rows, KIND)
INLINE int block_rows(const Shape *s, int first) {
    int end = first < s->tokens ? s->tokens : s->rows;
    return end - first < BLOCK ? end - first : BLOCK;
}

/* Attention of the rows from `from` on: mixed (rows, H) from qkv (rows, 3 H). */
#define attention NAMED(attention, KIND)
static TARGET void attention(float *mixed, const float *qkv, const Shape *s, int from, float *work) {
    long stride = 3 * s->mixed;
    float *p = work, *across = p + BLOCK * s->span;
    for (int h = 0; h < s->heads; h++) {
        const float *q = qkv + h * s->head, *k = q + s->mixed, *v = k + s->mixed;
        float *to = mixed + h * s->head;
        transpose(across, padded(s->tokens), k, stride, s->tokens, s->head);
        for (int first = from, rows; first < s->rows; first += rows) {
            rows = block_rows(s, first);
            int most = most_seen(s, first, rows), columns = padded(most);
            weigh(p, s, first, rows, columns, q + first * stride, k, across);
            product(to + first * s->mixed, s->mixed, p, s->span, 1, v, stride, most, 0, 0, rows, s->head);
            for (int r = 0; r < rows; r++)
                for (int own = s->own[first + r], j = 0; j < own; j++)
                    add_scaled(to + (first + r) * s->mixed, p[r * s->span + columns + j],
                               v + (first + r - own + 1 + j) * stride, s->head);
        }
    }
}

/* The gradient of q, k and v, d (rows, 3 H), from that of what attention gave, d_mixed. */
#define attention_back NAMED(attention_back, KIND)
static TARGET void attention_back(float *d, const float *d_mixed, const float *qkv, const Shape *s, int from, float *work) {
    long stride = 3 * s->mixed, span = s->span;
    float *p = work, *dp = p + BLOCK * span, *across = dp + BLOCK * span;
    float *v_across = across + (long)s->head * padded(s->tokens);
    memset(d, 0, (long)s->rows * stride * sizeof(float));
    for (int h = 0; h < s->heads; h++) {
        const float *q = qkv + h * s->head, *k = q + s->mixed, *v = k + s->mixed, *given = d_mixed + h * s->head;
        float *dq = d + h * s->head, *dk = dq + s->mixed, *dv = dk + s->mixed;
        transpose(across, padded(s->tokens), k, stride, s->tokens, s->head);
        transpose(v_across, padded(s->tokens), v, stride, s->tokens, s->head);
        for (int first = from, rows; first < s->rows; first += rows) {
            rows = block_rows(s, first);
            int most = most_seen(s, first, rows), columns = padded(most);
            const float *block = given + first * s->mixed;
            weigh(p, s, first, rows, columns, q + first * stride, k, across);
            product(dp, span, block, s->mixed, 1, v_across, padded(s->tokens), s->head, 0, 0, rows, columns);
            for (int r = 0; r < rows; r++) {
                int own = s->own[first + r], end = columns + padded(own);
                float *row = p + r * span, *d_row = dp + r * span;
                for (int j = 0; j < own; j++)
                    d_row[columns + j] = dot(block + r * s->mixed, v + (first + r - own + 1 + j) * stride, s->head);
                for (int j = own; j < end - columns; j++) d_row[columns + j] = 0.0f;
                V mean = all(dot(row, d_row, end));
                for (int c = 0; c < end; c += LANES) store(d_row + c, mul(load(row + c), sub(load(d_row + c), mean)));
            }
            product(dq + first * stride, stride, dp, span, 1, k, stride, most, 0, 0, rows, s->head);
            product(dk, stride, dp, 1, span, q + first * stride, stride, rows, dk, stride, most, s->head);
            product(dv, stride, p, 1, span, block, s->mixed, rows, dv, stride, most, s->head);
            for (int r = 0; r < rows; r++)
                for (int own = s->own[first + r], j = 0; j < own; j++) {
                    long at = (first + r - own + 1 + j) * stride;
                    float slope = dp[r * span + columns + j];
                    add_scaled(dq + (first + r) * stride, slope, k + at, s->head);
                    add_scaled(dk + at, slope, q + (first + r) * stride, s->head);
                    add_scaled(dv + at, p[r * span + columns + j], block + r * s->mixed, s->head);
                }
        }
    }
}

/* The loss of one query, and in y its gradient by the outputs y, times `share`. */
#define query_loss NAMED(query_loss, KIND)
INLINE float query_loss(float *y, const float *label, int actions, int gaussian, float share) {
    int wide = padded(actions);
    V loss = all(0.0f), factor = all(share);
    if (gaussian) { /* the means, then the inputs of a softplus that gives the standard deviations */
        for (int i = 0; i < wide; i += LANES) {
            M used = first_lanes(actions - i), positive;
            V raw = load(y + wide + i), zero = all(0.0f), one = all(1.0f);
            positive = greater(raw, zero);
            V small = exponential(choose(positive, sub(zero, raw), raw)), sigmoid, deviation, error;
            EACH(k) sigmoid.r[k] = 1.0f / (1.0f + small.r[k]);
            sigmoid = choose(positive, sigmoid, sub(one, sigmoid));
            deviation = add(all(0.05f), add(maximum(raw, zero), logarithm(add(one, small))));
            error = sub(load(label + i), load(y + i));
            V inverse = one;
            EACH(k) inverse.r[k] /= deviation.r[k];
            error = mul(error, inverse);
            V each = add(fma(mul(error, error), all(0.5f), logarithm(deviation)), all(0.918938533f));
            loss = add(loss, choose(used, each, zero));
            store(y + i, choose(used, mul(factor, sub(zero, mul(error, inverse))), zero));
            V d = mul(mul(inverse, sub(one, mul(error, error))), sigmoid);
            store(y + wide + i, choose(used, mul(factor, d), zero));
        }
        return sum(loss);
    }
    float top = y[0];
    for (int i = 1; i < actions; i++) top = y[i] > top ? y[i] : top;
    V total = all(0.0f), labels = all(0.0f);
    for (int i = 0; i < wide; i += LANES) {
        V shifted = sub(load(y + i), all(top)), target = load(label + i);
        total = add(total, choose(first_lanes(actions - i), exponential(shifted), all(0.0f)));
        labels = add(labels, target);
        loss = fma(target, shifted, loss);
    }
    float whole = sum(labels), partition = sum(total), logs[LANES];
    store(logs, logarithm(all(partition)));
    for (int i = 0; i < wide; i += LANES) {
        V e = mul(exponential(sub(load(y + i), all(top))), all(whole / partition));
        store(y + i, choose(first_lanes(actions - i), mul(factor, sub(e, load(label + i))), all(0.0f)));
    }
    return whole * logs[0] - sum(loss);
}

/* The sum of the losses of the queries of context b; the gradients of the parameters are added to `gradient`. */
TARGET float NAMED(icrl_fit, KIND)(const Fit *m, long b, float *gradient, float *work) {
    const float *weight = m->weight, *back = m->back;
    Shape s = {.width = m->width, .wide = padded(m->width), .heads = m->heads, .head = padded(m->width / m->heads)};
    s.mixed = s.heads * s.head, s.up = padded(4 * s.width), s.tokens = m->length[b], s.rows = s.tokens + m->queries;
    s.span = padded(s.tokens) + padded(m->window);
    long T = s.tokens, rows = s.rows, D = s.wide, H = s.mixed, U = s.up, stride = 3 * H;
    int outputs = padded(m->actions) << m->gaussian;
    Saved saved[m->layers + 1];
    for (int l = 0; l <= m->layers; l++)
        saved[l] = (Saved){take(&work, rows * D), take(&work, rows * D),      take(&work, rows * stride), take(&work, rows * H),
                           take(&work, rows * D), take(&work, rows * D), take(&work, rows * U)};
    float *active = take(&work, rows * U), *d_up = take(&work, rows * U), *d = take(&work, rows * D);
    float *d_normed = take(&work, rows * D), *d_qkv = take(&work, rows * stride), *d_mixed = take(&work, rows * H);
    float *y = take(&work, m->queries * outputs);
    s.limit = (int *)take(&work, rows), s.own = (int *)take(&work, rows);
    for (int r = 0; r < T; r++) s.limit[r] = r + 1, s.own[r] = 0;
    for (int r = T; r < rows; r++) s.limit[r] = m->prefix[b * m->queries + r - T], s.own[r] = m->own[r - T];
#define W(i) (weight + m->place[i])
#define BACK(i) (back + m->place[i])
#define G(i) (gradient + m->place[i])
#define NORM_OF(i) ((const Linear){W(i), W(i + 1)})
#define NORM_BACK(i, x, r) \
    layer_norm_back(d + r * D, d_normed + r * D, x + r * D, W(at + i), G(at + i), G(at + i + 1), s.width)
    const float *token = m->token + b * m->tokens * m->token_inputs, *query = m->query + b * m->queries * m->query_inputs;
    product(saved->x, D, token, m->token_inputs, 1, W(TOKEN), D, m->token_inputs, 0, 0, T, D);
    product(saved->x + T * D, D, query, m->query_inputs, 1, W(QUERY), D, m->query_inputs, 0, 0, m->queries, D);
    for (int l = 0; l < m->layers; l++) {
        Saved now = saved[l];
        int at = LAYERS + l * PER_LAYER, from = l == m->layers - 1 ? T : 0, left = rows - from;
        const float *qkv = W(at + QKV), *bias = W(at + QKV_BIAS);
        for (int r = 0; r < rows; r++) layer_norm(now.normed + r * D, now.x + r * D, NORM_OF(at + NORM_1), s.width);
        product(now.qkv + from * stride, stride, now.normed + from * D, D, 1, qkv, stride, D, bias, 0, left, H);
        product(now.qkv + H, stride, now.normed, D, 1, qkv + H, stride, D, bias + H, 0, rows, 2 * H);
        attention(now.mixed, now.qkv, &s, from, work);
        for (int r = from; r < rows; r++) add_to(now.middle + r * D, now.x + r * D, W(at + OUT_BIAS), D);
        product(now.middle + from * D, D, now.mixed + from * H, H, 1, W(at + OUT), D, H, now.middle + from * D, D, left, D);
        for (int r = from; r < rows; r++)
            layer_norm(now.normed_middle + r * D, now.middle + r * D, NORM_OF(at + NORM_2), s.width);
        product(now.up + from * U, U, now.normed_middle + from * D, D, 1, W(at + UP), U, D, W(at + UP_BIAS), 0, left, U);
        for (long i = from * U; i < rows * U; i += LANES) store(active + i, gelu(load(now.up + i)));
        float *next = saved[l + 1].x;
        for (int r = from; r < rows; r++) add_to(next + r * D, now.middle + r * D, W(at + DOWN_BIAS), D);
        product(next + from * D, D, active + from * U, U, 1, W(at + DOWN), D, U, next + from * D, D, left, D);
    }
    float *last = saved[m->layers].x + T * D, *normed = saved[m->layers].normed, loss = 0.0f;
    for (int r = 0; r < m->queries; r++) layer_norm(normed + r * D, last + r * D, NORM_OF(NORM), s.width);
    product(y, outputs, normed, D, 1, W(HEAD), outputs, D, W(HEAD_BIAS), 0, m->queries, outputs);
    const float *label = m->label + b * m->queries * padded(m->actions);
    for (int r = 0; r < m->queries; r++)
        loss += query_loss(y + r * outputs, label + r * padded(m->actions), m->actions, m->gaussian, m->share);

    product(G(HEAD), outputs, normed, 1, D, y, outputs, m->queries, G(HEAD), outputs, D, outputs);
    add_rows(G(HEAD_BIAS), y, outputs, m->queries, outputs);
    product(d_normed, D, y, outputs, 1, BACK(HEAD), D, outputs, 0, 0, m->queries, D);
    memset(d, 0, (long)rows * D * sizeof(float));
    for (int r = 0; r < m->queries; r++)
        layer_norm_back(d + (T + r) * D, d_normed + r * D, last + r * D, W(NORM), G(NORM), G(NORM_BIAS), s.width);
    for (int l = m->layers - 1; l >= 0; l--) { /* d: the gradient of what the layer gives, then of its input */
        Saved now = saved[l];
        int at = LAYERS + l * PER_LAYER, from = l == m->layers - 1 ? T : 0, left = rows - from;
        float *d_from = d + from * D;
        product(d_up + from * U, U, d_from, D, 1, BACK(at + DOWN), U, D, 0, 0, left, U);
        for (long i = from * U; i < rows * U; i += LANES) {
            V x = load(now.up + i);
            store(active + i, gelu(x));
            store(d_up + i, mul(load(d_up + i), gelu_slope(x)));
        }
        product(G(at + DOWN), D, active + from * U, 1, U, d_from, D, left, G(at + DOWN), D, U, D);
        add_rows(G(at + DOWN_BIAS), d_from, D, left, D);
        product(G(at + UP), U, now.normed_middle + from * D, 1, D, d_up + from * U, U, left, G(at + UP), U, D, U);
        add_rows(G(at + UP_BIAS), d_up + from * U, U, left, U);
        product(d_normed + from * D, D, d_up + from * U, U, 1, BACK(at + UP), D, U, 0, 0, left, D);
        for (int r = from; r < rows; r++) NORM_BACK(NORM_2, now.middle, r);
        product(G(at + OUT), D, now.mixed + from * H, 1, H, d_from, D, left, G(at + OUT), D, H, D);
        add_rows(G(at + OUT_BIAS), d_from, D, left, D);
        product(d_mixed + from * H, H, d_from, D, 1, BACK(at + OUT), H, D, 0, 0, left, H);
        attention_back(d_qkv, d_mixed, now.qkv, &s, from, work);
        float *g = G(at + QKV);
        product(g, stride, now.normed + from * D, 1, D, d_qkv + from * stride, stride, left, g, stride, D, H);
        product(g + H, stride, now.normed, 1, D, d_qkv + H, stride, rows, g + H, stride, D, 2 * H);
        add_rows(G(at + QKV_BIAS), d_qkv, stride, rows, stride);
        product(d_normed, D, d_qkv, stride, 1, BACK(at + QKV), D, stride, 0, 0, rows, D);
        for (int r = 0; r < rows; r++) NORM_BACK(NORM_1, now.x, r);
    }
    product(G(TOKEN), D, token, 1, m->token_inputs, d, D, T, G(TOKEN), D, m->token_inputs, D);
    product(G(QUERY), D, query, 1, m->query_inputs, d + T * D, D, m->queries, G(QUERY), D, m->query_inputs, D);
    return loss;
}

/* to = the sum of `count` arrays of n numbers, in order. */
TARGET void NAMED(icrl_sum, KIND)(float *to, const float *parts, long n, long count) {
    for (long i = 0; i < n; i += LANES) {
        V total = load(parts + i);
        for (long c = 1; c < count; c++) total = add(total, load(parts + c * n + i));
        store(to + i, total);
    }
}

/* The sum of the squares of n numbers, a multiple of 16. */
TARGET float NAMED(icrl_squares, KIND)(const float *x, long n) {
    V total = all(0.0f);
    for (long i = 0; i < n; i += LANES) total = fma(load(x + i), load(x + i), total);
    return sum(total);
}

/* Five steps of Newton and Schulz towards the nearest orthogonal matrix, as Muon makes them: x (rows, columns), of a norm
   below 1, in place; both are multiples of 16.  work: 2 rows (rows + columns) numbers. */
TARGET void NAMED(icrl_orthogonal, KIND)(float *x, long rows, long columns, float a, float b, float c, float *work) {
    float *across = work, *next = across + rows * columns, *gram = next + rows * columns, *change = gram + rows * rows;
    for (int step = 0; step < 5; step++) {
        transpose(across, rows, x, columns, rows, columns);
        product(gram, rows, x, columns, 1, across, rows, columns, 0, 0, rows, rows);
        for (long i = 0; i < rows * rows; i += LANES) store(change + i, mul(all(b / c), load(gram + i)));
        product(change, rows, gram, rows, 1, gram, rows, rows, change, rows, rows, rows);
        for (long i = 0; i < rows * rows; i += LANES) store(change + i, mul(all(c), load(change + i)));
        for (long i = 0; i < rows * columns; i += LANES) store(next + i, mul(all(a), load(x + i)));
        product(next, columns, change, rows, 1, x, columns, rows, next, columns, rows, columns);
        memcpy(x, next, rows * columns * sizeof(float));
    }
}
#endif
