# docker build -t geodelreg .
# docker run --rm --network none --user "$(id -u):$(id -g)" -v "$PWD:/data" geodelreg align ms.tif pan.tif -o aligned.tif

FROM python:3.13-slim AS build
WORKDIR /source
COPY . .
ARG EXTRAS=report
RUN python -m venv /opt/geodelreg \
    && /opt/geodelreg/bin/pip install --no-cache-dir ".[${EXTRAS}]"

FROM python:3.13-slim
COPY --from=build /opt/geodelreg /opt/geodelreg
ENV PATH=/opt/geodelreg/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1
RUN useradd --create-home --uid 1000 geodelreg
USER 1000:1000
WORKDIR /data
ENTRYPOINT ["geodelreg"]
CMD ["--help"]
