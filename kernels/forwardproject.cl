// Line integrals through a volume by Joseph's method (IEEE Trans. Med. Imaging 1, 192 (1982)): a
// ray is sampled once a plane across the axis along which it advances fastest, bilinearly within
// the plane; the sum is multiplied by the length of ray between two planes. Outside the volume is
// zero, towards which the interpolation runs over one voxel.
//
// forward_rays treats any geometry. forward_columns, for CPUs (LANES 8), treats views whose v is
// parallel to z: the rays of a detector column share their place across the column's plane, and
// their heights there are linear in the row. So two adjacent voxel columns are blended once and the
// blend is resampled.
//
// A work-item makes BLOCK rows of one column. It sums over the planes from_plane to to_plane - 1
// and adds to what projections hold if from_plane > 0, so that the host can take the volume in
// parts that stay in the cache for all views. Global sizes are (blocks, columns, count), rounded up
// at will. Every voxel, and the one beyond, has to be in front of every source.

#include "geometry.clh"

#ifndef BLOCK
#define BLOCK (LANES == 1 ? 1 : 48 * LANES) // whole LANES
#endif

// The volume, part of its planes, and one view's rays.
typedef struct {
    global const float *volume;
    int nx;
    int ny;
    int nz;
    global const float *view;
    int from_plane;
    int to_plane;
} scene;

// voxels along an axis, and elements from one to the next
static inline int size(const scene s, const int axis)
{
    return axis == 0 ? s.nx : axis == 1 ? s.ny : s.nz;
}

static inline size_t stride(const scene s, const int axis)
{
    return axis == 0 ? (size_t)s.nz : axis == 1 ? (size_t)s.nz * s.nx : 1;
}

// the part of enter <= t <= leave with start + slope t > limit
static inline void keep_above(
    const float start, const float slope, const float limit, float *enter, float *leave)
{
    const float t = (limit - start) / slope;
    if (slope > 0.0f)
        *enter = LARGER(*enter, t);
    else if (slope < 0.0f)
        *leave = SMALLER(*leave, t);
}

// the part with start + slope t > -1 on one line and < size on the other
static inline void keep_inside(
    const float start,
    const float high_slope,
    const float low_slope,
    const int size,
    float *enter,
    float *leave)
{
    keep_above(start, high_slope, -1.0f, enter, leave);
    keep_above(-start, -low_slope, -size, enter, leave);
}

// Sum of the samples of one ray (c, r), taken across axis p.
static inline float trace(const scene s, const float c, const float r, const int p)
{
    const int q = p == 0 ? 1 : 0;
    const int l = p == 2 ? 1 : 2;
    const float start_p = s.view[12 + p];
    const float start_q = s.view[12 + q];
    const float start_l = s.view[12 + l];
    const float advance = ALONG(float, s.view, p, c, r);
    const float slope_q = ALONG(float, s.view, q, c, r) / advance;
    const float slope_l = ALONG(float, s.view, l, c, r) / advance;
    const int end = min(s.to_plane, size(s, p)) - 1;
    const int most_q = size(s, q) - 1;
    const int most_l = size(s, l) - 1;
    float enter = s.from_plane - start_p;
    float leave = end - start_p;
    keep_inside(start_q, slope_q, slope_q, most_q + 1, &enter, &leave);
    keep_inside(start_l, slope_l, slope_l, most_l + 1, &enter, &leave);
    float sum = 0.0f;
    if (!(enter <= leave))
        return sum;
    // one plane more at each end, against rounding
    const int first = max((int)(enter + start_p), s.from_plane);
    const int last = min((int)(leave + start_p) + 1, end);
    const size_t stride_q = stride(s, q);
    const size_t stride_l = stride(s, l);
    for (int plane = first; plane <= last; ++plane) {
        const float at_q = fma(plane - start_p, slope_q, start_q);
        const float at_l = fma(plane - start_p, slope_l, start_l);
        const int iq = below(at_q);
        const int il = below(at_l);
        if (iq < -1 || iq > most_q || il < -1 || il > most_l)
            continue;
        const float low_q = iq < 0 ? 0.0f : 1.0f - (at_q - iq);
        const float low_l = il < 0 ? 0.0f : 1.0f - (at_l - il);
        const float high_q = iq < most_q ? at_q - iq : 0.0f;
        const float high_l = il < most_l ? at_l - il : 0.0f;
        global const float *line = s.volume + plane * stride(s, p);
        global const float *low = line + max(iq, 0) * stride_q;
        global const float *high = line + min(iq + 1, most_q) * stride_q;
        const size_t l0 = max(il, 0) * stride_l;
        const size_t l1 = min(il + 1, most_l) * stride_l;
        sum += low_q * (low_l * low[l0] + high_l * low[l1]) +
               high_q * (low_l * high[l0] + high_l * high[l1]);
    }
    return sum;
}

#if LANES == 8
// Sums of the samples of rays (c, r + lane), taken across axis p, x or y, by all of them.
static inline float8 trace_lanes(const scene s, const float c, const float r, const int p)
{
    const int q = 1 - p;
    const float start_p = s.view[12 + p];
    const float start_q = s.view[12 + q];
    const float start_z = s.view[14];
    const float8 row = r + RAMP;
    const float8 advance = ALONG(float8, s.view, p, c, row);
    const float8 slope_q = ALONG(float8, s.view, q, c, row) / advance;
    const float8 slope_z = ALONG(float8, s.view, 2, c, row) / advance;
    const float begin = s.from_plane - start_p;
    const int end_plane = min(s.to_plane, size(s, p)) - 1;
    const float end = end_plane - start_p;
    const int most = size(s, q) - 1;
    const size_t stride_q = stride(s, q);
    // t = plane - start_p has one sign, so that an outer lane is the leftmost or lowest throughout
    const float sign = begin + end > 0.0f ? 1.0f : -1.0f;
    const float left_slope = sign * SMALLER(sign * slope_q.s0, sign * slope_q.s7);
    const float right_slope = sign * LARGER(sign * slope_q.s0, sign * slope_q.s7);
    const float low_slope = sign * SMALLER(sign * slope_z.s0, sign * slope_z.s7);
    const float high_slope = sign * LARGER(sign * slope_z.s0, sign * slope_z.s7);
    // planes where any lane can be within one voxel of the volume
    float enter = begin, leave = end;
    keep_inside(start_q, right_slope, left_slope, most + 1, &enter, &leave);
    keep_inside(start_z, high_slope, low_slope, s.nz, &enter, &leave);
    float8 sum = 0.0f;
    if (!(enter <= leave))
        return sum;
    // one plane more at each end, against rounding
    const int first = max((int)(enter + start_p), s.from_plane);
    const int last = min((int)(leave + start_p) + 1, end_plane);
    for (int plane = first; plane <= last; ++plane) {
        const float t = plane - start_p;
        const float8 at_q = t * slope_q + start_q;
        const float8 at_z = t * slope_z + start_z;
        const int low = below(t * left_slope + start_q);
        const int high = below(t * right_slope + start_q) + 1;
        const int base = below(t * low_slope + start_z);
        global const float *line = s.volume + plane * stride(s, p);
        if (low >= 0 && high <= most && high <= low + 2 && base >= 0 && base <= s.nz - WINDOW &&
            t * (high_slope - low_slope) <= SPAN - 1.0f) {
            line += low * stride_q + base;
            sum += among(line, stride_q, at_q - (float)low, at_z - (float)base, high == low + 2);
        } else {
            for (int i = max(low, 0); i <= min(high, most); ++i)
                sum += hat(at_q - (float)i) * taps(line + i * stride_q, s.nz, at_z);
        }
    }
    return sum;
}
#endif

kernel void forward_rays(
    global float *restrict projections, // (count, columns + 1, pitch), padded
    const ulong projections_offset,
    global const float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int pitch, // elements of a padded line
    const int count, // views
    const int from_plane, // planes across x, y or z; from_plane > 0: add to the projections
    const int to_plane,
    const float voxel_size) // [mm]
{
    projections += projections_offset + PAD;
    const int first = get_global_id(0) * BLOCK;
    const int c = get_global_id(1);
    const int view = get_global_id(2);
    if (first >= rows || c >= columns || view >= count)
        return;
    const scene s = {
        volume + volume_offset,
        nx,
        ny,
        nz,
        views + views_offset + view * VIEW_FLOATS,
        from_plane,
        to_plane};
    global float *line = projections + ((size_t)view * (columns + 1) + c) * pitch;
    for (int r = first; r < min(first + BLOCK, rows); r += LANES) {
        real d[3];
        for (int axis = 0; axis < 3; ++axis)
            d[axis] = ALONG(real, s.view, axis, c, r + RAMP);
        float sum[LANES];
#if LANES == 8
        const int axis = main_axis(s.view, c, r, 0);
        const float8 advance = axis ? d[1] : d[0];
        if (axis < 2 && all(sampled_across(axis, d) & (advance * advance.s0 > 0.0f)))
            store_lanes(trace_lanes(s, c, r, axis), sum);
        else
#endif
            for (int lane = 0; lane < LANES; ++lane)
                sum[lane] = trace(s, c, r + lane, main_axis(s.view, c, r + lane, 0));
        const real x = fabs(d[0]);
        const real y = fabs(d[1]);
        const real z = fabs(d[2]);
        const real most = LARGER(LARGER(x, y), z);
        const real length = voxel_size * sqrt(x * x + y * y + z * z) / most;
        store_lanes(load_lanes(sum) * length, sum);
        for (int lane = 0; lane < min(LANES, rows - r); ++lane)
            line[r + lane] = from_plane > 0 ? line[r + lane] + sum[lane] : sum[lane];
    }
}

#if LANES == 8
kernel void forward_columns(
    global float *restrict projections, // (count, columns + 1, pitch), padded
    const ulong projections_offset,
    global const float *restrict volume, // (ny, nx, nz)
    const ulong volume_offset,
    global const float *restrict views, // (count, VIEW_FLOATS)
    const ulong views_offset,
    const int nx, // voxels
    const int ny,
    const int nz,
    const int columns, // pixels
    const int rows,
    const int pitch, // elements of a padded line
    const int count, // views
    const int from_plane, // planes across x or y; from_plane > 0: add to the projections
    const int to_plane,
    const float voxel_size) // [mm]
{
    projections += projections_offset + PAD;
    volume += volume_offset;
    views += views_offset;
    const int r = get_global_id(0) * BLOCK;
    const int c = get_global_id(1);
    const int view = get_global_id(2);
    if (r >= rows || c >= columns || view >= count)
        return;
    const int pixels = min(BLOCK, rows - r);
    global const float *m = views + view * VIEW_FLOATS;
    const int axis = main_axis(m, c, 0.0f, 1);
    const int across = axis ? nx : ny;
    const size_t plane_stride = axis ? (size_t)nx * nz : nz;
    const size_t across_stride = axis ? nz : (size_t)nx * nz;
    const float start_p = m[12 + axis];
    const float start_q = m[13 - axis];
    const float start_z = m[14];
    const float advance = ALONG(float, m, axis, c, 0.0f);
    const float drift = ALONG(float, m, 1 - axis, c, 0.0f);
    const float rise = ALONG(float, m, 2, c, (float)r);
    const float rise_per_row = m[23];
    const float inverse = 1.0f / advance;
    const float slope_q = drift * inverse;

    // planes where the column is within one voxel of the volume, one more against rounding
    const int end_plane = min(to_plane, axis ? ny : nx) - 1;
    float enter = from_plane - start_p;
    float leave = end_plane - start_p;
    keep_inside(start_q, slope_q, slope_q, across, &enter, &leave);
    const int seen = enter <= leave;
    if (!seen && from_plane > 0)
        return;
    const int first_plane = seen ? max((int)(enter + start_p), from_plane) : 0;
    const int last_plane = seen ? min((int)(leave + start_p) + 1, end_plane) : -1;

    float sum[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
    for (int plane = first_plane; plane <= last_plane; ++plane) {
        const float q = fma(plane - start_p, slope_q, start_q);
        if (!(q > -1.0f && q < across))
            continue;
        const float t = (plane - start_p) * inverse;
        const float z = fma(t, rise, start_z);
        const float slope = t * rise_per_row;
        // the rows at the volume's ends
        const float per_voxel = 1.0f / slope;
        const float one = (-1.0f - z) * per_voxel;
        const float other = (nz - z) * per_voxel;
        const float first = SMALLER(one, other);
        const float last = LARGER(one, other);
        if (last < 0.0f || first >= pixels)
            continue;
        const int start = (int)LARGER(first, 0.0f) / LANES * LANES;
        const int stop = (int)SMALLER(last, pixels - 1.0f) + 1;

        const int low = below(q);
        const float next_weight = low + 1 < across ? q - low : 0.0f;
        const float line_weight = low < 0 ? 0.0f : 1.0f - (q - low);
        global const float *line = volume + plane * plane_stride + max(low, 0) * across_stride;
        global const float *next =
            volume + plane * plane_stride + min(low + 1, across - 1) * across_stride;
        if (fabs(slope) * (LANES - 1) > SPAN || nz < WINDOW) {
            for (int k = start; k < stop; ++k) {
                const float h = fma(slope, (float)k, z);
                sum[k] += line_weight * tap(line, nz, h) + next_weight * tap(next, nz, h);
            }
            continue;
        }
        steps step = steps_from(fma(slope, (float)start, z), slope);
        for (int k = start; k < stop; k += LANES) {
            const int base = step_base(step);
            const int8 at = step_lanes(step);
            float8 value;
            if ((uint)base <= (uint)(nz - WINDOW)) {
                const float16 blend = line_weight * load_window(line + base) +
                                      next_weight * load_window(next + base);
                value = between(blend, whole_part(at), fraction(at));
            } else {
                const int within = clamp(base, 0, nz - WINDOW);
                const float16 blend = line_weight * load_window(line + within) +
                                      next_weight * load_window(next + within);
                value = between_zeros(blend, whole_part(at) + (base - within), fraction(at));
            }
            store_lanes(load_lanes(sum + k) + value, sum + k);
            step.lowest += step.advance;
        }
    }
    const float scale = voxel_size * fabs(inverse);
    const float level = advance * advance + drift * drift;
    global float *target = projections + ((size_t)view * (columns + 1) + c) * pitch + r;
    for (int k = 0; k < pixels; ++k) {
        const float climb = fma((float)k, rise_per_row, rise);
        const float integral = sum[k] * scale * sqrt(level + climb * climb);
        target[k] = from_plane > 0 ? target[k] + integral : integral;
    }
}
#endif
