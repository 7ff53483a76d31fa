// Least squares for a small rigid motion of the sample in each view.
//
// A ray is x = s + g r with r = d0 + a u + b v, (a, b) its column and row from the detector's centre,
// and g its depth. With M0 = integral of f dg and M1 = integral of f / g dg, a motion of the sample by
// the velocity t + w x (x - c) changes the line integral |r| M0 by
//
//     -|r| [ A_u dM1/da + A_v dM1/db + B_u dM0/da + B_v dM0/db - B_r M0 ]
//
// where t + w x (s - c) = A_u u + A_v v + A_r r and w x r = B_u u + B_v v + B_r r. Along a detector
// A_u = y_u - y_r (a + a0), A_v = y_v - y_r (b + b0), and B_u, B_v, B_r likewise with y linear in a and b.
// Derivatives are central differences over two neighbours on each side; rays beyond the border count as
// the outermost one.
//
// A view is VIEW_NUMBERS numbers: a0, b0; |r|^2 as the six coefficients of 1, a, b, a^2, b^2, a b; and for
// each of the six parameters y_u, y_v, y_r, then the coefficients of 1, a, b of w . u, w . v and w . r.

#include "group.clh"

#define PARAMETERS 6
#define PER_PARAMETER 12
#define VIEW_NUMBERS (8 + PARAMETERS * PER_PARAMETER)
#define IMAGES 8 // six derivatives, the simulated radiograph, measured less simulated
#define PRODUCTS (IMAGES * (IMAGES + 1) / 2)

static inline float inverse_length(global const float *view, const float a, const float b)
{
    const float square = view[2] + a * (view[3] + a * view[5]) + b * (view[4] + b * view[6]) +
                         a * b * view[7];
    return rsqrt(square);
}

// line integral of ray (column, row) over |r|, of the nearest ray on the detector
static inline float moment(
    global const float *integrals,
    global const float *view,
    const int columns,
    const int rows,
    const int column,
    const int row)
{
    const int c = clamp(column, 0, columns - 1), r = clamp(row, 0, rows - 1);
    const float a = c - 0.5f * (columns - 1), b = r - 0.5f * (rows - 1);
    return integrals[(size_t)r * columns + c] * inverse_length(view, a, b);
}

static inline float central(const float before2, const float before, const float after, const float after2)
{
    return (before2 - after2) * (1.0f / 12.0f) + (after - before) * (2.0f / 3.0f);
}

// Global size (columns, rows, count), rounded up at will.
kernel required_group void rigid_derivatives(
    global float *restrict images, // (count, IMAGES, rows, columns)
    const ulong images_offset,
    global const float *restrict measured, // (count, rows, columns), line integrals
    const ulong measured_offset,
    global const float *restrict simulated, // likewise
    const ulong simulated_offset,
    global const float *restrict over_depth, // integrals of f / g, likewise
    const ulong over_depth_offset,
    global const float *restrict views, // (count, VIEW_NUMBERS)
    const ulong views_offset,
    const int columns,
    const int rows,
    const int count)
{
    const int c = get_global_id(0), r = get_global_id(1), n = get_global_id(2);
    if (c >= columns || r >= rows || n >= count)
        return;
    const size_t area = (size_t)rows * columns;
    const size_t at = (size_t)r * columns + c;
    global const float *m0 = simulated + simulated_offset + n * area;
    global const float *m1 = over_depth + over_depth_offset + n * area;
    global const float *view = views + views_offset + n * VIEW_NUMBERS;
    const float a = c - 0.5f * (columns - 1), b = r - 0.5f * (rows - 1);
    const float length = 1.0f / inverse_length(view, a, b);
#define M(m, i, j) moment(m, view, columns, rows, c + (i), r + (j))
    const float m0_a = central(M(m0, -2, 0), M(m0, -1, 0), M(m0, 1, 0), M(m0, 2, 0));
    const float m0_b = central(M(m0, 0, -2), M(m0, 0, -1), M(m0, 0, 1), M(m0, 0, 2));
    const float m1_a = central(M(m1, -2, 0), M(m1, -1, 0), M(m1, 1, 0), M(m1, 2, 0));
    const float m1_b = central(M(m1, 0, -2), M(m1, 0, -1), M(m1, 0, 1), M(m1, 0, 2));
#undef M
    const float here = m0[at] / length;
    const float u0 = a + view[0], v0 = b + view[1];
    global float *image = images + images_offset + n * IMAGES * area + at;
    for (int k = 0; k < PARAMETERS; ++k) {
        global const float *y = view + 8 + k * PER_PARAMETER;
        const float along = y[9] + a * y[10] + b * y[11];
        const float a_u = y[0] - y[2] * u0;
        const float a_v = y[1] - y[2] * v0;
        const float b_u = y[3] + a * y[4] + b * y[5] - along * u0;
        const float b_v = y[6] + a * y[7] + b * y[8] - along * v0;
        image[k * area] =
            -length * (a_u * m1_a + a_v * m1_b + b_u * m0_a + b_v * m0_b - along * here);
    }
    image[PARAMETERS * area] = m0[at];
    image[(PARAMETERS + 1) * area] = measured[measured_offset + n * area + at] - m0[at];
}

// Weighted sums of the products of every two of a view's IMAGES over some rows. STRANDS work-items share
// the rows, each taking every STRANDS-th column from its own on: neighbours read neighbours.
//
// Global size (STRANDS, blocks, count), rounded up at will.
kernel required_group void rigid_products(
    global float *restrict sums, // (count, blocks, strands, PRODUCTS)
    const ulong sums_offset,
    global const float *restrict images, // (count, IMAGES, rows, columns)
    const ulong images_offset,
    global const float *restrict weights, // (rows, columns)
    const ulong weights_offset,
    const int columns,
    const int rows,
    const int first_row, // of those with weight
    const int end_row,
    const int first_column,
    const int end_column,
    const int block_rows,
    const int blocks,
    const int strands,
    const int count)
{
    const int strand = get_global_id(0), block = get_global_id(1), n = get_global_id(2);
    if (strand >= strands || block >= blocks || n >= count)
        return;
    const size_t area = (size_t)rows * columns;
    global const float *image = images + images_offset + n * IMAGES * area;
    global const float *weight = weights + weights_offset;
    const int from = first_row + block * block_rows;
    const int to = min(from + block_rows, end_row);
#if LANES > 1
    float8 wide[PRODUCTS];
    for (int k = 0; k < PRODUCTS; ++k)
        wide[k] = 0.0f;
#endif
    float sum[PRODUCTS];
    for (int k = 0; k < PRODUCTS; ++k)
        sum[k] = 0.0f;
    for (int r = from; r < to; ++r) {
        const size_t line = (size_t)r * columns;
        int c = first_column + strand;
#if LANES > 1
        for (; c + 8 <= end_column; c += 8) {
            float8 value[IMAGES];
            for (int i = 0; i < IMAGES; ++i)
                value[i] = vload8(0, image + i * area + line + c);
            const float8 w = vload8(0, weight + line + c);
            for (int i = 0, k = 0; i < IMAGES; ++i) {
                const float8 weighted = w * value[i];
                for (int j = i; j < IMAGES; ++j, ++k)
                    wide[k] += weighted * value[j];
            }
        }
#endif
        for (; c < end_column; c += strands) {
            float value[IMAGES];
            for (int i = 0; i < IMAGES; ++i)
                value[i] = image[i * area + line + c];
            const float w = weight[line + c];
            for (int i = 0, k = 0; i < IMAGES; ++i)
                for (int j = i; j < IMAGES; ++j, ++k)
                    sum[k] += w * value[i] * value[j];
        }
    }
    global float *out =
        sums + sums_offset + (((size_t)n * blocks + block) * strands + strand) * PRODUCTS;
    for (int k = 0; k < PRODUCTS; ++k) {
#if LANES > 1
        const float8 w = wide[k];
        sum[k] += w.s0 + w.s1 + w.s2 + w.s3 + w.s4 + w.s5 + w.s6 + w.s7;
#endif
        out[k] = sum[k];
    }
}

// Global size (PRODUCTS, count), rounded up at will.
kernel required_group void rigid_totals(
    global float *restrict totals, // (count, PRODUCTS)
    const ulong totals_offset,
    global const float *restrict sums, // (count, parts, PRODUCTS)
    const ulong sums_offset,
    const int parts,
    const int count)
{
    const int k = get_global_id(0), n = get_global_id(1);
    if (k >= PRODUCTS || n >= count)
        return;
    global const float *part = sums + sums_offset + (size_t)n * parts * PRODUCTS + k;
    float total = 0.0f;
    for (int i = 0; i < parts; ++i)
        total += part[(size_t)i * PRODUCTS];
    totals[totals_offset + (size_t)n * PRODUCTS + k] = total;
}
