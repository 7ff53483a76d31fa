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
// A work-item makes BLOCK rows of one column from the planes from_plane to to_plane - 1, so that
// the host can choose a part of the volume that stays in the cache for all views. Global sizes are
// (blocks, columns, count), rounded up at will. Every voxel, and the one beyond, has to be in front
// of every source.

#include "geometry.clh"

#ifndef BLOCK
#define BLOCK (LANES == 1 ? 1 : 48 * LANES) // whole LANES
#endif

// The volume and one view's rays in it.
typedef struct {
    global const float *volume;
    int shape[3];
    size_t stride[3];
    global const float *view;
    int from_plane;
    int to_plane;
} scene;

// where a ray is at `start + slope t` with -1 < . < size, t in planes
static inline void clip(
    const float start, const float slope, const int size, float *enter, float *leave)
{
    const float one = (-1.0f - start) / slope;
    const float other = (size - start) / slope;
    *enter = fmax(*enter, fmin(one, other)); // these see to NaN, where the ray stays inside
    *leave = fmin(*leave, fmax(one, other));
}

// Sum of the samples of one ray (c, r), taken across `axis`.
static inline float trace(const scene s, const float c, const float r, const int axis)
{
    const int p = axis;
    const int q = axis == 0 ? 1 : 0;
    const int l = axis == 2 ? 1 : 2;
    const float start_p = s.view[12 + p];
    const float start_q = s.view[12 + q];
    const float start_l = s.view[12 + l];
    const float advance = ALONG(float, s.view, p, c, r);
    const float slope_q = ALONG(float, s.view, q, c, r) / advance;
    const float slope_l = ALONG(float, s.view, l, c, r) / advance;
    float enter = s.from_plane - start_p;
    float leave = min(s.to_plane, s.shape[p]) - 1 - start_p;
    clip(start_q, slope_q, s.shape[q], &enter, &leave);
    clip(start_l, slope_l, s.shape[l], &enter, &leave);
    float sum = 0.0f;
    if (!(enter <= leave))
        return sum;
    // one plane more at each end, against rounding
    const int first = max((int)(enter + start_p), s.from_plane);
    const int last = min((int)(leave + start_p) + 1, min(s.to_plane, s.shape[p]) - 1);
    for (int plane = first; plane <= last; ++plane) {
        const float at_q = fma(plane - start_p, slope_q, start_q);
        const float at_l = fma(plane - start_p, slope_l, start_l);
        if (!(at_q > -1.0f && at_q < s.shape[q] && at_l > -1.0f && at_l < s.shape[l]))
            continue;
        const int iq = below(at_q);
        const int il = below(at_l);
        const float high_q = iq + 1 < s.shape[q] ? at_q - iq : 0.0f;
        const float high_l = il + 1 < s.shape[l] ? at_l - il : 0.0f;
        const float low_q = iq < 0 ? 0.0f : 1.0f - (at_q - iq);
        const float low_l = il < 0 ? 0.0f : 1.0f - (at_l - il);
        global const float *low = s.volume + plane * s.stride[p] + max(iq, 0) * s.stride[q];
        global const float *high =
            s.volume + plane * s.stride[p] + min(iq + 1, s.shape[q] - 1) * s.stride[q];
        const size_t l0 = max(il, 0) * s.stride[l];
        const size_t l1 = min(il + 1, s.shape[l] - 1) * s.stride[l];
        sum += low_q * (low_l * low[l0] + high_l * low[l1]) +
               high_q * (low_l * high[l0] + high_l * high[l1]);
    }
    return sum;
}

#if LANES == 8
// Sums of the samples of rays (c, r + lane), taken across `axis`, x or y, by all of them.
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
    const float first_q = slope_q.s0, last_q = slope_q.s7;
    const float first_z = slope_z.s0, last_z = slope_z.s7;
    const float begin = s.from_plane - start_p;
    const float end = min(s.to_plane, s.shape[p]) - 1 - start_p;
    float8 sum = 0.0f;
    // planes where a ray may be in the volume: one lies between those of the outer lanes
    float enter[2] = {begin, begin}, leave[2] = {end, end};
    float enter_z[2] = {begin, begin}, leave_z[2] = {end, end};
    clip(start_q, first_q, s.shape[q], enter, leave);
    clip(start_q, last_q, s.shape[q], enter + 1, leave + 1);
    clip(start_z, first_z, s.shape[2], enter_z, leave_z);
    clip(start_z, last_z, s.shape[2], enter_z + 1, leave_z + 1);
    const float in = LARGER(SMALLER(enter[0], enter[1]), SMALLER(enter_z[0], enter_z[1]));
    const float out = SMALLER(LARGER(leave[0], leave[1]), LARGER(leave_z[0], leave_z[1]));
    if (!(in <= out))
        return sum;
    const int first = max((int)(in + start_p), s.from_plane);
    const int last = min((int)(out + start_p) + 1, min(s.to_plane, s.shape[p]) - 1);
    const int most = s.shape[q] - 1;
    for (int plane = first; plane <= last; ++plane) {
        const float t = plane - start_p;
        const float one_q = fma(t, first_q, start_q), other_q = fma(t, last_q, start_q);
        const float one_z = fma(t, first_z, start_z), other_z = fma(t, last_z, start_z);
        const float left = SMALLER(one_q, other_q), right = LARGER(one_q, other_q);
        const float bottom = SMALLER(one_z, other_z), top = LARGER(one_z, other_z);
        if (right <= -1.0f || left > most + 1.0f || top <= -1.0f || bottom >= s.shape[2])
            continue;
        const float8 at_q = fma((float8)(t), slope_q, (float8)(start_q));
        const float8 at_z = fma((float8)(t), slope_z, (float8)(start_z));
        const int low = below(left);
        const int high = below(right) + 1;
        global const float *line = s.volume + plane * s.stride[p];
        const int base = below(bottom);
        if (top - bottom > SPAN || high > low + 1 || (uint)base > (uint)(s.shape[2] - WINDOW) || s.shape[2] < WINDOW || low < 0 || high > most) {
            for (int i = max(low, 0); i <= min(high, most); ++i)
                sum += hat(at_q - (float)i) * taps(line + i * s.stride[q], s.shape[2], at_z);
            continue;
        }
        const float8 at = at_z - (float)base;
        const int8 n = convert_int8(at);
        const float8 f = at - convert_float8(n);
        line += low * s.stride[q] + base;
        sum += hat(at_q - (float)low) * between(load_window(line), n, f);
        line += s.stride[q];
        sum += hat(at_q - (low + 1.0f)) * between(load_window(line), n, f);
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
    scene s = {volume + volume_offset, {nx, ny, nz}, {nz, (size_t)nz * nx, 1}, views + views_offset + view * VIEW_FLOATS, from_plane, to_plane};
    global float *line = projections + ((size_t)view * (columns + 1) + c) * pitch;
    for (int r = first; r < min(first + BLOCK, rows); r += LANES) {
        real d[3];
        for (int axis = 0; axis < 3; ++axis)
            d[axis] = ALONG(real, s.view, axis, c, r + RAMP);
        float sum[LANES];
        int axis = main_axis(s.view, c, r, 0);
#if LANES == 8
        const float8 advance = axis ? d[1] : d[0];
        if (axis < 2 && all(sampled_across(axis, d) & (advance * advance.s0 > 0.0f)))
            store_lanes(trace_lanes(s, c, r, axis), sum);
        else
#endif
            for (int lane = 0; lane < LANES; ++lane)
                sum[lane] = trace(s, c, r + lane, main_axis(s.view, c, r + lane, 0));
        const real x = fabs(d[0]), y = fabs(d[1]), z = fabs(d[2]);
        const real most = LARGER(LARGER(x, y), z);
        store_lanes(load_lanes(sum) * voxel_size * sqrt(x * x + y * y + z * z) / most, sum);
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

    float sum[BLOCK];
    for (int k = 0; k < BLOCK; ++k)
        sum[k] = 0.0f;
    const int end = min(to_plane, axis ? ny : nx) - 1;
    for (int plane = from_plane; plane <= end; ++plane) {
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
