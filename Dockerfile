# One image for every part: scheduler, workers, service and the steps before them; docker-compose.yml says which is which.
FROM python:3.12-slim AS build
WORKDIR /build
RUN python -m venv /opt/tract
COPY constraints.txt pyproject.toml README.md LICENSE ./
COPY tract_dask tract_dask
# Wheels only: nothing is compiled, so neither stage needs a compiler.
RUN /opt/tract/bin/pip install --no-cache-dir --only-binary :all: --no-binary tract_dask \
        --constraint constraints.txt . \
    && /opt/tract/bin/pip uninstall --yes pip \
    && find /opt/tract -depth -type d \( -name tests -o -name test \) -path '*/site-packages/*/*' -not -path '*/numba/*' \
        -exec rm -rf {} +

FROM python:3.12-slim
# One thread for each library, and memory that is used again: what local workers get by themselves.
ENV PATH=/opt/tract/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/srv/cache \
    NUMBA_NUM_THREADS=1 \
    OMP_NUM_THREADS=1 \
    OPENBLAS_NUM_THREADS=1 \
    MKL_NUM_THREADS=1 \
    RAYON_NUM_THREADS=1 \
    BLOSC_NTHREADS=1 \
    ZARR_THREADING__MAX_WORKERS=1 \
    MALLOC_MMAP_THRESHOLD_=33554432 \
    MALLOC_TRIM_THRESHOLD_=67108864 \
    JE_ARROW_MALLOC_CONF=background_thread:false
# Volumes take over the owner of the folders that they are mounted on.
RUN useradd --uid 1000 --create-home tract \
    && install -d -o tract -g tract -m 750 /srv/data /srv/cache /srv/certs /srv/authority \
    && install -d -o tract -g tract -m 700 /srv/state
COPY --from=build /opt/tract /opt/tract
COPY --chmod=755 deploy/healthcheck /usr/local/bin/healthcheck
USER tract
WORKDIR /srv/data
EXPOSE 8000
HEALTHCHECK --interval=30s --timeout=10s --start-period=60s \
    CMD ["healthcheck", "http://127.0.0.1:8000/api/v1/health"]
CMD ["tract-dask", "serve", "--data-root", "/srv/data", "--state-dir", "/srv/state"]
