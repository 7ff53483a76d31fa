/* A host in C: forward-projects a ball that is densest in its middle, with the kernel forward_rays.
 *
 *     python -m clra.kernels KERNELS
 *     cc -I KERNELS project_sphere.c -lOpenCL -lm -o project_sphere
 *     ./project_sphere KERNELS OUT
 *
 * OUT gets float32 (VIEWS, ROWS, COLUMNS) in the machine's byte order. The first device that builds
 * the kernel is used and named on stdout. Exit status: 0, 1 where something fails, 77 where there
 * is no device that builds it.
 */
#define CL_TARGET_OPENCL_VERSION 120
#include <CL/cl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "clra_kernels.h"

enum { VIEWS = 5, COLUMNS = 23, ROWS = 19, N = 21 }; /* N voxels along each axis */
enum { VIEW_FLOATS = 28 }; /* geometry.clh */
static const double VOXEL = 0.1, SOURCE = 5.0, DETECTOR = 3.0, PIXEL = 0.17; /* mm */
enum { DIAMETER = 16 }; /* voxels */
static const float ATTENUATION = 1.0f / 512; /* 1/mm */

static void check(cl_int status, const char *what)
{
    if (status != CL_SUCCESS) {
        fprintf(stderr, "%s: OpenCL error %d\n", what, status);
        exit(1);
    }
}

static char *read_text(const char *folder, const char *name)
{
    char path[4096];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, "rb");
    if (file == NULL) {
        perror(path);
        exit(1);
    }
    fseek(file, 0, SEEK_END);
    const long size = ftell(file);
    rewind(file);
    char *text = calloc(size + 1, 1);
    if (text == NULL || fread(text, 1, size, file) != (size_t)size)
        exit(1);
    fclose(file);
    return text;
}

/* the first device that builds the text, with its context */
static cl_program build(const char *text, cl_device_id *device, cl_context *context)
{
    cl_platform_id platforms[16];
    cl_uint count = 0;
    clGetPlatformIDs(16, platforms, &count);
    for (cl_uint p = 0; p < count && p < 16; ++p) {
        cl_int status;
        if (clGetDeviceIDs(platforms[p], CL_DEVICE_TYPE_ALL, 1, device, NULL) != CL_SUCCESS)
            continue;
        *context = clCreateContext(NULL, 1, device, NULL, NULL, &status);
        if (status != CL_SUCCESS)
            continue;
        cl_program program = clCreateProgramWithSource(*context, 1, &text, NULL, &status);
        if (clBuildProgram(program, 1, device, "-cl-std=CL1.2", NULL, NULL) == CL_SUCCESS)
            return program;
        clReleaseProgram(program);
        clReleaseContext(*context);
    }
    fprintf(stderr, "no device of %u platforms builds the kernel\n", count);
    exit(77);
}

/* A view as geometry.clh has it; positions in voxels from voxel (0, 0, 0). forward_rays reads no
 * projection matrix, which is left zero. */
static void fill_view(float *view, double angle)
{
    const double c = cos(angle), s = sin(angle), middle = 0.5 * (N - 1);
    const double source[3] = {SOURCE * c, SOURCE * s, 0};
    const double detector[3] = {-DETECTOR * c, -DETECTOR * s, 0};
    const double u[3] = {-PIXEL * s, PIXEL * c, 0};
    const double v[3] = {0, 0, -PIXEL};
    for (int axis = 0; axis < 3; ++axis) {
        const double corner = detector[axis] - source[axis] - 0.5 * (COLUMNS - 1) * u[axis] -
                              0.5 * (ROWS - 1) * v[axis];
        view[12 + axis] = source[axis] / VOXEL + middle;
        view[15 + axis] = corner / VOXEL;
        view[18 + axis] = u[axis] / VOXEL;
        view[21 + axis] = v[axis] / VOXEL;
    }
}

static cl_mem buffer(cl_context context, size_t floats, float *host)
{
    cl_int status;
    const cl_mem_flags flags = CL_MEM_READ_WRITE | (host ? CL_MEM_COPY_HOST_PTR : 0);
    cl_mem memory = clCreateBuffer(context, flags, floats * sizeof(float), host, &status);
    check(status, "clCreateBuffer");
    return memory;
}

int main(int argc, char **argv)
{
    if (argc != 3) {
        fprintf(stderr, "usage: %s KERNELS OUT\n", argv[0]);
        return 2;
    }
    static float volume[N * N * N], views[VIEWS * VIEW_FLOATS];
    static float projections[VIEWS * ROWS * COLUMNS];
    for (int y = 0; y < N; ++y)
        for (int x = 0; x < N; ++x)
            for (int z = 0; z < N; ++z) { /* twice the distance from the middle, in whole numbers */
                const int i = 2 * x - (N - 1), j = 2 * y - (N - 1), k = 2 * z - (N - 1);
                const int depth = DIAMETER * DIAMETER - (i * i + j * j + k * k);
                volume[(y * N + x) * N + z] = ATTENUATION * (depth > 0 ? depth : 0);
            }
    for (int view = 0; view < VIEWS; ++view)
        fill_view(views + view * VIEW_FLOATS, 0.3 + view * 1.1);

    char *text = read_text(argv[1], CLRA_FORWARD_RAYS_FILE);
    cl_device_id device;
    cl_context context;
    cl_program program = build(text, &device, &context);
    char name[256] = "";
    clGetDeviceInfo(device, CL_DEVICE_NAME, sizeof name, name, NULL);
    puts(name);

    cl_int status;
    cl_command_queue queue = clCreateCommandQueue(context, device, 0, &status);
    check(status, "clCreateCommandQueue");
    cl_kernel kernel = clCreateKernel(program, CLRA_FORWARD_RAYS, &status);
    check(status, "clCreateKernel");
    cl_mem out = buffer(context, sizeof projections / sizeof(float), NULL);
    cl_mem in = buffer(context, N * N * N, volume);
    cl_mem table = buffer(context, VIEWS * VIEW_FLOATS, views);

    const cl_ulong start = 0;
    const cl_int n = N, columns = COLUMNS, rows = ROWS, count = VIEWS, accumulate = 0;
    const cl_float voxel = VOXEL;
#define SET(argument, value)                                                                       \
    check(clSetKernelArg(kernel, CLRA_FORWARD_RAYS_##argument, sizeof(value), &(value)), #argument)
    SET(PROJECTIONS, out);
    SET(PROJECTIONS_OFFSET, start);
    SET(VOLUME, in);
    SET(VOLUME_OFFSET, start);
    SET(VIEWS, table);
    SET(VIEWS_OFFSET, start);
    SET(NX, n);
    SET(NY, n);
    SET(NZ, n);
    SET(COLUMNS, columns);
    SET(ROWS, rows);
    SET(COUNT, count);
    SET(VOXEL_SIZE, voxel);
    SET(ACCUMULATE, accumulate);
    const size_t size[3] = {ROWS, COLUMNS, VIEWS};
    check(clEnqueueNDRangeKernel(queue, kernel, 3, NULL, size, NULL, 0, NULL, NULL), "enqueue");
    check(clEnqueueReadBuffer(queue, out, CL_TRUE, 0, sizeof projections, projections, 0, NULL, NULL),
          "read");

    FILE *file = fopen(argv[2], "wb");
    if (file == NULL) {
        perror(argv[2]);
        return 1;
    }
    fwrite(projections, sizeof(float), VIEWS * ROWS * COLUMNS, file);
    fclose(file);
    clReleaseMemObject(out);
    clReleaseMemObject(in);
    clReleaseMemObject(table);
    clReleaseKernel(kernel);
    clReleaseCommandQueue(queue);
    clReleaseProgram(program);
    clReleaseContext(context);
    free(text);
    return 0;
}
