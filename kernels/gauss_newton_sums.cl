// The normal equations of gauss_newton.cl: sums over the image of the products of its terms.

#ifndef GROUP
#define GROUP 1 // work-items of one block of rows: 1 on CPUs, 64 on GPUs
#endif
#if GROUP > 1
#define LANES 1
#endif

#include "vectors.clh"
#include "gauss_newton.clh"

// Weights of the cubic B-spline's four coefficients around a point f past the second, e = 1 - f,
// and their derivatives.
#define SPLINE(f, e)                                                                               \
    {(e) * (e) * (e) * (1.0f / 6.0f), (2.0f / 3.0f) - (f) * (f) * (1.0f - 0.5f * (f)),             \
     (2.0f / 3.0f) - (e) * (e) * (1.0f - 0.5f * (e)), (f) * (f) * (f) * (1.0f / 6.0f)}
#define SPLINE_SLOPE(f, e)                                                                         \
    {-0.5f * (e) * (e), (f) * (1.5f * (f) - 2.0f), (e) * (2.0f - 1.5f * (e)), 0.5f * (f) * (f)}

// A view's images and where it stands.
typedef struct {
    global const float *coefficients; // lined (rows, stride): of B
    global const float *measured; // lined (BLURS, most_views, rows, stride), at the view: A_k
    global const float *window; // lined (rows, stride): w
    global const float *valid; // lined (rows, stride): 1 where B may be used, else 0
    ulong blur; // elements from one A_k to the next
    int rows, columns, stride;
    float2 shift;
    float growth; // 1/m - 1
    float inverse_radius; // 1/h, 1/pixels
} counterparts;

// The spline and its derivatives along x and y, u and f past the second of four by four
// coefficients, whose first are those of column x - 1 and row y - 1.
inlined void
spline_at(const counterparts s, const int x, const int y, const real u, const float f, real *b,
          real *p, real *q)
{
    *b = *p = *q = 0.0f;
    const float wy[4] = SPLINE(f, 1.0f - f), sy[4] = SPLINE_SLOPE(f, 1.0f - f);
    const real wx[4] = SPLINE(u, 1.0f - u), sx[4] = SPLINE_SLOPE(u, 1.0f - u);
#pragma unroll
    for (int k = 0; k < 4; ++k) {
        real value = 0.0f, slope = 0.0f;
#pragma unroll
        for (int l = 0; l < 4; ++l) {
            const int line = clamp(y - 1 + l, 0, s.rows - 1) * s.stride + (MARGIN + x - 1);
            const real c = load_global(s.coefficients + line + k);
            value += wy[l] * c;
            slope += sy[l] * c;
        }
        *b += wx[k] * value;
        *p += sx[k] * value;
        *q += wx[k] * slope;
    }
}

// The terms of LANES pixels from (j, i) on; returns w. Each group of LANES columns takes the
// spline's piece under its middle: in the outer ones the point lies up to LANES/2 |1/m - 1| beyond
// the knot, where the piece differs from its neighbour by the cube of that only. So no lane loads
// from an address of its own.
inlined real
terms_at(const counterparts s, const int j, const int i, real term[TERMS])
{
    const float2 centre = 0.5f * (float2)(s.columns - 1, s.rows - 1);
    // Displacements, not positions, are interpolated at: they keep all their digits.
    const float distance_v = (j - centre.y - s.shift.y) * (1.0f + s.growth);
    const float dy = (j - centre.y) * s.growth - s.shift.y * (1.0f + s.growth);
    const int y = j + (int)floor(dy), nearest = j + (int)floor(dy + 0.5f);
    const float f = dy - floor(dy);
    const float middle =
        (i + 0.5f * (LANES - 1) - centre.x) * s.growth - s.shift.x * (1.0f + s.growth);
    // Far outside the detector all is 0 anyway.
    const int x = clamp(i + (int)floor(middle), -LANES - 4, s.columns + 3);
    const real lanes = RAMP;
    const real u = middle - floor(middle) + (lanes - 0.5f * (LANES - 1)) * s.growth;
    real b, p, q;
    spline_at(s, x, y, u, f, &b, &p, &q);
    const real distance_u = (i - centre.x - s.shift.x + lanes) * (1.0f + s.growth);
    term[0] = p;
    term[1] = q;
    term[2] = (p * distance_u + q * distance_v) * s.inverse_radius;
    term[3] = b;
    term[4] = 1.0f;
    const int near = x + (middle - floor(middle) >= 0.5f);
    const int line = clamp(nearest, 0, s.rows - 1) * s.stride + MARGIN;
    const float used = nearest >= 0 && nearest < s.rows;
    return used * load_global(s.window + j * s.stride + MARGIN + i) *
           load_global(s.valid + line + near);
}

// Sums of the normal equations over blocks of rows. Work-group (GROUP, 1, 1), global size
// (GROUP, blocks, views). A work-item keeps all sums of its pixels in its registers; those of a
// group are added at the end.
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void normal_equations(
    global float *restrict sums, // (views, blocks, SUMS)
    const ulong sums_offset,
    global const float *restrict measured, // lined (BLURS, most_views, rows, stride): A_k
    const ulong measured_offset,
    const int most_views,
    global const float *restrict coefficients, // lined (views, rows, stride): of B
    const ulong coefficients_offset,
    global const float *restrict window, // lined (rows, stride): w
    const ulong window_offset,
    global const float *restrict valid, // lined (rows, stride): 1 where B may be used, else 0
    const ulong valid_offset,
    global const float *restrict state, // (views, STATE)
    const ulong state_offset,
    const int rows,
    const int columns,
    const int stride,
    const int top, // first row that counts
    const int bottom, // one past the last
    const int left, // first column that counts
    const int right, // one past the last
    const int block_rows, // rows of a block
    const float inverse_radius, // 1/h, 1/pixels
    const int views)
{
    const int block = get_global_id(1), view = get_global_id(2);
    state += state_offset + view * STATE;
    if (state[DONE] != 0.0f)
        return; // the whole work-group leaves

    const counterparts s = {
        coefficients + coefficients_offset + (ulong)view * rows * stride,
        measured + measured_offset + (ulong)view * rows * stride,
        window + window_offset,
        valid + valid_offset,
        (ulong)most_views * rows * stride,
        rows,
        columns,
        stride,
        (float2)(state[SHIFT_U], state[SHIFT_V]),
        -state[GROWTH] / (1.0f + state[GROWTH]),
        inverse_radius};
    const int start = top + block * block_rows, stop = min(bottom, start + block_rows);
    sums += sums_offset + ((ulong)view * get_global_size(1) + block) * SUMS;
    real term[TERMS];
    real sum[SUMS];
#pragma unroll
    for (int k = 0; k < SUMS; ++k)
        sum[k] = 0.0f;
    for (int j = start; j < stop; ++j)
        for (int i = left + get_local_id(0) * LANES; i < right; i += GROUP * LANES) {
            const real w = terms_at(s, j, i, term);
#pragma unroll
            for (int k = 0; k < BLURS; ++k)
                term[5 + k] = load_global(s.measured + k * s.blur + j * stride + MARGIN + i);
#pragma unroll
            for (int k = 0; k < TERMS; ++k) {
                const real weighted = w * term[k];
#pragma unroll
                for (int other = 0; other < TERMS; ++other)
                    if (other >= k)
                        sum[OF(k, other)] += weighted * term[other];
            }
        }
#if GROUP == 1
    for (int k = 0; k < SUMS; ++k)
        sums[k] = sum_lanes(sum[k]);
#else
    local float shared[SUMS][GROUP + 1]; // + 1: the sums lie in different banks
    const int item = get_local_id(0);
#pragma unroll
    for (int k = 0; k < SUMS; ++k)
        shared[k][item] = sum[k];
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int k = item; k < SUMS; k += GROUP) {
        float total = 0.0f;
        for (int n = 0; n < GROUP; ++n)
            total += shared[k][n];
        sums[k] = total;
    }
#endif
}
