# docker build -t vehicle-detection .
# docker run --rm -v "$PWD:/data" vehicle-detection demo -o demo
# docker run --rm -v "$PWD:/data" --user "$(id -u)" vehicle-detection batch CARD -o results
FROM python:3.12-slim
COPY pyproject.toml README.md LICENSE /source/
COPY vehicle_detection /source/vehicle_detection
RUN pip install --no-cache-dir "/source[batch]" && rm -r /source
# Any user may run it, and the compiled kernels and settings of matplotlib are kept in /cache.
ENV HOME=/cache NUMBA_CACHE_DIR=/cache/kernels MPLCONFIGDIR=/cache/matplotlib
RUN mkdir -m 777 /cache && useradd --no-create-home --home-dir /cache user
USER user
WORKDIR /data
ENTRYPOINT ["vehicle-detection"]
CMD ["--help"]
