# warpslam in a container: docker build -t warpslam . ; docker run --rm -v "$PWD:/data" warpslam run /data/scans/kitchen
# With a GPU: docker run --gpus all ... (Warp brings its own CUDA; the host needs the driver and NVIDIA's container toolkit.)
# Watched: docker run -p 8080:8080 ... run /data/scan --view-at 0.0.0.0:8080
# Files of one's own, not root's: docker run -u "$(id -u):$(id -g)" ...
FROM python:3.11-slim

ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility \
    PIP_NO_CACHE_DIR=1 PYTHONUNBUFFERED=1 WARP_CACHE_PATH=/data/.warp-cache MPLCONFIGDIR=/tmp/matplotlib

COPY . /src
# torch only reads decoder files: its CPU build is a third of the size.
RUN pip install --no-deps -c /src/constraints.txt torch --index-url https://download.pytorch.org/whl/cpu \
    && pip install -c /src/constraints.txt "/src[bags,exr,mesh,record3d,view]" \
    && rm -rf /src

WORKDIR /data
EXPOSE 8080
ENTRYPOINT ["warpslam"]
CMD ["--help"]
