// The ramp filter of a pair of detector rows in one launch, in local memory: weight, Fourier
// transform, multiply, transform back, cut. For GPUs and rows that fit; ramp.cl says how rows are
// weighed and continued.
//
// The two rows are the real and the imaginary part of one line: the ramp's spectrum is real and
// even, so that they stay apart. The transform takes four elements at a time and leaves frequencies
// with their base-4 digits reversed (and last, where LENGTH is no power of 4, pairs of them);
// `ramp` has that order, and the way back undoes it. Twiddles come from a table: native functions
// are not exact enough.
//
// Work-group (GROUP, 1, 1) for each pair of rows of a view, of `rows` from row `top` of the detector
// on; global size GROUP times their number, views ceil(rows / 2).

#include "ramp.clh"

#ifndef LENGTH
#define LENGTH 1024 // of a line, a power of 2, at least 4
#endif
#ifndef GROUP
#define GROUP 64
#endif

// Every sixteenth element is left out: neighbours that are 4, 16, ... apart lie in other banks.
#define PLACE(i) ((i) + ((i) >> 4))

static inline float2 times(const float2 a, const float2 b)
{
    return (float2)(a.x * b.x - a.y * b.y, fma(a.x, b.y, a.y * b.x));
}

// times the conjugate of b
static inline float2 times_conjugate(const float2 a, const float2 b)
{
    return (float2)(fma(a.x, b.x, a.y * b.y), a.y * b.x - a.x * b.y);
}

// One stage over spans of 4 `quarter` elements, forward; `twiddles` are exp(-2 pi i k / LENGTH).
static inline void
stage(local float2 *line, global const float2 *twiddles, const int item, const int quarter)
{
    const int step = LENGTH / 4 / quarter;
    for (int i = item; i < LENGTH / 4; i += GROUP) {
        const int j = i & (quarter - 1), at = 4 * (i - j) + j;
        const float2 a = line[PLACE(at)], b = line[PLACE(at + quarter)];
        const float2 c = line[PLACE(at + 2 * quarter)], d = line[PLACE(at + 3 * quarter)];
        const float2 even = a + c, odd = a - c, sum = b + d;
        const float2 turned = (float2)(b.y - d.y, d.x - b.x); // -i (b - d)
        line[PLACE(at)] = even + sum;
        line[PLACE(at + quarter)] = times(odd + turned, twiddles[j * step]);
        line[PLACE(at + 2 * quarter)] = times(even - sum, twiddles[2 * j * step]);
        line[PLACE(at + 3 * quarter)] = times(odd - turned, twiddles[3 * j * step]);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// the same stage backwards, times 4
static inline void
unstage(local float2 *line, global const float2 *twiddles, const int item, const int quarter)
{
    const int step = LENGTH / 4 / quarter;
    for (int i = item; i < LENGTH / 4; i += GROUP) {
        const int j = i & (quarter - 1), at = 4 * (i - j) + j;
        const float2 a = line[PLACE(at)];
        const float2 b = times_conjugate(line[PLACE(at + quarter)], twiddles[j * step]);
        const float2 c = times_conjugate(line[PLACE(at + 2 * quarter)], twiddles[2 * j * step]);
        const float2 d = times_conjugate(line[PLACE(at + 3 * quarter)], twiddles[3 * j * step]);
        const float2 even = a + c, odd = a - c, sum = b + d;
        const float2 turned = (float2)(d.y - b.y, b.x - d.x); // i (b - d)
        line[PLACE(at)] = even + sum;
        line[PLACE(at + quarter)] = odd + turned;
        line[PLACE(at + 2 * quarter)] = even - sum;
        line[PLACE(at + 3 * quarter)] = odd - turned;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Sums and differences of neighbours: both ways alike.
static inline void pairs(local float2 *line, const int item)
{
    for (int i = item; i < LENGTH / 2; i += GROUP) {
        const float2 a = line[PLACE(2 * i)], b = line[PLACE(2 * i + 1)];
        line[PLACE(2 * i)] = a + b;
        line[PLACE(2 * i + 1)] = a - b;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void filter_pairs(
    global float *filtered, // (views, height, wider), may be the projections if that is no larger
    const ulong filtered_offset,
    global const float *projections, // (views, rows, columns), line integrals
    const ulong projections_offset,
    global const float *restrict view_table, // (views, VIEW_FIELDS)
    const ulong view_table_offset, // of the projections' first view
    global const float *restrict row_weight, // (height,)
    const ulong row_weight_offset,
    global const float *restrict ray_weight, // (views, columns) of the projections, or (columns,)
    const ulong ray_weight_offset,
    global const float *restrict roll, // (LENGTH - columns,): what columns past the detector keep
    const ulong roll_offset,
    global const float *restrict ramp, // (LENGTH,): spectrum / LENGTH, in the transform's order
    const ulong ramp_offset,
    global const float2 *restrict twiddles, // (LENGTH,): exp(-2 pi i k / LENGTH)
    const ulong twiddles_offset,
    const int rows, // of a view of the projections
    const int top,
    const int height,
    const int columns,
    const int ray_stride, // columns, or 0 if all views have the same ray weights
    const int wider, // columns of `filtered`
    const int before) // of these, left of the detector, at the line's end
{
    local float2 line[PLACE(LENGTH)];
    filtered += filtered_offset;
    projections += projections_offset;
    view_table += view_table_offset;
    row_weight += row_weight_offset;
    roll += roll_offset;
    ramp += ramp_offset;
    twiddles += twiddles_offset;
    const int item = get_local_id(0), pairs_of_view = (rows + 1) / 2;
    const int view = (int)get_group_id(0) / pairs_of_view;
    ray_weight += ray_weight_offset + (ulong)view * ray_stride;
    const int first = 2 * ((int)get_group_id(0) % pairs_of_view), both = first + 1 < rows;
    const int other = first + both; // the last row of an odd number is taken twice
    const LineWeight one = line_weight(view_table, row_weight, view, top + first);
    const LineWeight two = line_weight(view_table, row_weight, view, top + other);
    global const float *p = projections + ((ulong)view * rows + first) * columns;
    global const float *q = p + both * columns;
    filtered += ((ulong)view * height + top + first) * wider;
    for (int i = item; i < LENGTH; i += GROUP) {
        const int from = source_column(i, columns, LENGTH);
        const float part = ray_weight[from] * (i < columns ? 1.0f : roll[i - columns]);
        float2 value = 0.0f;
        if (part != 0.0f)
            value = part * (float2)(p[from] * weight_at(one, from), q[from] * weight_at(two, from));
        line[PLACE(i)] = value;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    int quarter = LENGTH / 4;
    for (; quarter >= 1; quarter /= 4)
        stage(line, twiddles, item, quarter);
    // LENGTH is 4^n: quarter went down to 1; or 2 4^n: it went down to 2, and pairs are left.
#if (LENGTH & 0x55555555) == 0
    pairs(line, item);
#endif
    for (int i = item; i < LENGTH; i += GROUP)
        line[PLACE(i)] *= ramp[i];
    barrier(CLK_LOCAL_MEM_FENCE);
#if (LENGTH & 0x55555555) == 0
    pairs(line, item);
    quarter = 2;
#else
    quarter = 1;
#endif
    for (; quarter <= LENGTH / 4; quarter *= 4)
        unstage(line, twiddles, item, quarter);
    for (int i = item; i < wider; i += GROUP) {
        const int from = i < before ? i - before + LENGTH : i - before;
        const float2 value = line[PLACE(from)];
        filtered[i] = value.x;
        if (both)
            filtered[wider + i] = value.y;
    }
}
