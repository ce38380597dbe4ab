#!/bin/sh
# The sketch with Arduino's own AVR core, by the flags of its IDE: build.sh MCU VARIANT FOLDER SKETCH [-DNAME=VALUE ...]
set -eu
mcu=$1 variant=$2 out=$3 sketch=$4
shift 4
root=/usr/share/arduino/hardware/arduino/avr
wire=$root/libraries/Wire/src
flags="-c -Os -flto -ffunction-sections -fdata-sections -mmcu=$mcu -DF_CPU=16000000L -DARDUINO=10819 -DARDUINO_ARCH_AVR"
flags="$flags -I$root/cores/arduino -I$root/variants/$variant -I$wire"
[ "$variant" = leonardo ] && flags="$flags -DUSB_VID=0x2341 -DUSB_PID=0x8036"
cpp="avr-g++ $flags -std=gnu++11 -fpermissive -fno-exceptions -fno-threadsafe-statics"
mkdir -p "$out"
for file in "$root"/cores/arduino/*.cpp "$wire"/*.cpp; do
    case $file in */WString.cpp) continue ;; esac # the sketch has no strings, and gcc 5 refuses it
    $cpp -w "$file" -o "$out/$(basename "$file").o"
done
for file in "$root"/cores/arduino/*.c "$wire"/utility/*.c; do
    avr-gcc $flags -fno-fat-lto-objects -w -std=gnu11 "$file" -o "$out/$(basename "$file").o"
done
for file in "$root"/cores/arduino/*.S; do
    avr-gcc -c -x assembler-with-cpp -flto -mmcu="$mcu" -DF_CPU=16000000L "$file" -o "$out/$(basename "$file").o"
done
$cpp -Wall -Wextra -include Arduino.h "$@" -x c++ "$sketch" -o "$out/sketch.o"
avr-gcc -Os -flto -fuse-linker-plugin -Wl,--gc-sections -mmcu="$mcu" "$out"/*.o -lm -o "$out/firmware.elf"
avr-size "$out/firmware.elf"
